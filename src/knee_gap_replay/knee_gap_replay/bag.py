"""Bags: see knee_gap_node.bag."""

from knee_gap_node.bag.bag import BagMessage as BagMessage
from knee_gap_node.bag.bag import BagReader as BagReader
from knee_gap_node.bag.bag import BagWriter as BagWriter
from knee_gap_node.bag.bag import Topic as Topic
