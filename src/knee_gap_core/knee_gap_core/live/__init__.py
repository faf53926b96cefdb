"""The live nodes: their base on rclpy, lifecycle, wiring to a core, and topics inside of one process."""
