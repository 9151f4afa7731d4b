"""Stands in for ROS 2's rclpy where no ROS is: the part of it that the driver calls, by its signatures.

Topics come over a socket on loopback from the program that ROS_GRAPH_PORT names, serialised as ROS 2 does.
"""

import json
import os
import select
import socket
import struct
from collections.abc import Callable
from typing import Any, BinaryIO


class Context:
    """One membership in the graph."""

    is_open = False


def init(*, context: Context) -> None:
    context.is_open = True


def try_shutdown(*, context: Context) -> None:
    context.is_open = False


class Node:
    """A member: knows the topics, and receives what it has subscribed to."""

    def __init__(self, name: str, context: Context) -> None:
        assert context.is_open and name.isidentifier()
        self._socket = socket.create_connection(("127.0.0.1", int(os.environ["ROS_GRAPH_PORT"])))
        self._stream: BinaryIO = self._socket.makefile("rb")
        self._topics: dict[str, list[str]] = json.loads(self._stream.readline())
        self._receivers: dict[str, Callable[[bytes], None]] = {}

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return list(self._topics.items())

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[bytes], None], qos_profile: Any, *, raw: bool
    ) -> None:
        assert raw and self._topics[topic] == [msg_type.name] and qos_profile == "best effort"
        self._receivers[topic] = callback
        self._socket.sendall(b"go\n")

    def destroy_node(self) -> None:
        self._stream.close()
        self._socket.close()

    def receive(self, timeout_s: float) -> None:
        if select.select([self._socket], [], [], timeout_s)[0]:
            head = self._stream.read(8)
            if len(head) < 8:
                return
            n_name, n_data = struct.unpack("<II", head)
            topic, data = self._stream.read(n_name).decode(), self._stream.read(n_data)
            if topic in self._receivers:
                self._receivers[topic](data)


def create_node(name: str, *, context: Context) -> Node:
    return Node(name, context)
