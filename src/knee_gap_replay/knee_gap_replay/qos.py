"""Quality of service, as bags keep it: see knee_gap_node.bag."""

from knee_gap_node.bag.qos import PROFILES as PROFILES
from knee_gap_node.bag.qos import QosName as QosName
from knee_gap_node.bag.qos import is_latched as is_latched
