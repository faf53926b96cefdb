"""Message types without ROS: see knee_gap_node.bag."""

from knee_gap_node.bag.types import blank as blank
from knee_gap_node.bag.types import check_type_hash as check_type_hash
from knee_gap_node.bag.types import full_name as full_name
from knee_gap_node.bag.types import known_type as known_type
from knee_gap_node.bag.types import message_class as message_class
from knee_gap_node.bag.types import typestore as typestore
