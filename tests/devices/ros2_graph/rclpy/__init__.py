"""Stands in for ROS 2's rclpy where no ROS is: the part of it that the driver calls, by its signatures.

Topics come over a socket on loopback from the program that ROS_GRAPH_PORT names, serialised as ROS 2 does.
"""

import json
import os
import select
import socket
import struct


class Context:
    """One membership in the graph."""

    is_open = False


def init(*, context):
    context.is_open = True


def try_shutdown(*, context):
    context.is_open = False


class Node:
    """A member: knows the topics, and receives what it has subscribed to."""

    def __init__(self, name, context):
        assert context.is_open and name.isidentifier()
        self._socket = socket.create_connection(("127.0.0.1", int(os.environ["ROS_GRAPH_PORT"])))
        self._stream = self._socket.makefile("rb")
        self._topics = json.loads(self._stream.readline())
        self._receivers = {}

    def get_topic_names_and_types(self):
        return list(self._topics.items())

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, raw):
        assert raw and self._topics[topic] == [msg_type.name] and qos_profile == "best effort"
        self._receivers[topic] = callback
        self._socket.sendall(b"go\n")

    def destroy_node(self):
        self._stream.close()
        self._socket.close()

    def receive(self, timeout_s):
        if select.select([self._socket], [], [], timeout_s)[0]:
            head = self._stream.read(8)
            if len(head) < 8:
                return
            n_name, n_data = struct.unpack("<II", head)
            topic, data = self._stream.read(n_name).decode(), self._stream.read(n_data)
            if topic in self._receivers:
                self._receivers[topic](data)


def create_node(name, *, context):
    return Node(name, context)
