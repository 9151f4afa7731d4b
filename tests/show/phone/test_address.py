import ipaddress

import pytest

from lce_rig.core.errors import UsageError
from lce_rig.show.phone.preview import Preview, links, listen, parse_address

from .conftest import port_of


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("", "127.0.0.1", 8765),
        ("9000", "127.0.0.1", 9000),
        (":9000", "127.0.0.1", 9000),
        ("0", "127.0.0.1", 0),
        ("host:", "host", 8765),
        ("0.0.0.0", "0.0.0.0", 8765),
        ("0.0.0.0:80", "0.0.0.0", 80),
        ("rig.local:9000", "rig.local", 9000),
        (" localhost ", "localhost", 8765),
    ],
)
def test_preview_addresses_accept_common_forms(text, host, port):
    assert parse_address(text) == (host, port)


@pytest.mark.parametrize(
    "text",
    ["host:port", "host:70000", "1:2:3", "::1", "[::1]:9000", "http://host:1", "a b", "host:-1", "host:8_0",
     "host:٣"],
)  # fmt: skip
def test_preview_invalid_address_is_refused_with_examples(text):
    with pytest.raises(UsageError) as caught:
        parse_address(text)
    assert "0.0.0.0:8765" in caught.value.hint


def test_preview_port_in_use_is_reported():
    with Preview(port=0) as first:
        port = port_of(first)
        with pytest.raises(UsageError):
            Preview(port=port).start()
    with Preview(port=port):
        pass  # it is free again at once


def test_links_reach_this_computer():
    with listen("0.0.0.0", 0) as opened:
        port = opened.getsockname()[1]
        found = links(opened, "abcdefgh")
    for link in found:
        assert link.endswith(f":{port}/?token=abcdefgh")
        host = link.removeprefix("http://").partition(":")[0]
        if not host.endswith(".local"):
            assert not ipaddress.ip_address(host).is_loopback
            with listen(host, 0):
                pass  # only own addresses can be bound
