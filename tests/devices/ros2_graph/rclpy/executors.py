"""See `rclpy`."""


class SingleThreadedExecutor:
    """Calls the receivers of its node, one message a time."""

    def __init__(self, *, context):
        assert context.is_open

    def add_node(self, node):
        self._node = node

    def spin_once(self, timeout_sec):
        self._node.receive(timeout_sec)

    def shutdown(self):
        pass
