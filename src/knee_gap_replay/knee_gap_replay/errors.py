"""What goes wrong with bags: see knee_gap_node.bag."""

from knee_gap_node.bag.errors import BagError as BagError
