"""See `rclpy`."""

import rclpy


class SingleThreadedExecutor:
    """Calls the receivers of its node, one message a time."""

    def __init__(self, *, context: rclpy.Context) -> None:
        assert context.is_open

    def add_node(self, node: rclpy.Node) -> None:
        self._node = node

    def spin_once(self, timeout_sec: float) -> None:
        self._node.receive(timeout_sec)

    def shutdown(self) -> None:
        pass
