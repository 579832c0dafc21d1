"""The URLs that describe links."""

import pytest

from risaf_link.errors import LinkError
from risaf_link.links import (
    Link,
    MemoryLink,
    SerialLink,
    TcpInLink,
    TcpOutLink,
    TlogLink,
    UdpInLink,
    UdpOutLink,
    open_link,
)


def no_clock() -> int:
    raise AssertionError("the clock was read")


@pytest.mark.parametrize(
    ("url", "kind"),
    [
        ("serial:///dev/ttyACM0:3000000", SerialLink),
        ("serial:///dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:115200", SerialLink),
        ("udpin://0.0.0.0:14560", UdpInLink),
        ("udpin://[::]:0", UdpInLink),
        ("udpout://ground-station.local:14550", UdpOutLink),
        ("udpout://[fe80::1%eth0]:14550", UdpOutLink),
        ("tcpin://127.0.0.1:5760", TcpInLink),
        ("tcpout://[2001:db8::1]:65535", TcpOutLink),
        ("tlog:///var/log/risaf/flight 1.tlog", TlogLink),
        ("memory://here", MemoryLink),
    ],
)
def test_a_url_makes_a_link_and_opens_nothing(url: str, kind: type[Link]) -> None:
    link = open_link(url, "some", no_clock)
    assert type(link) is kind
    assert link.name == "some"
    assert link.counts.connections == 0


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("", "one of serial:///dev/NAME:BAUD, udpin://ADDRESS:PORT"),
        ("/dev/ttyACM0", "one of serial:///dev/NAME:BAUD"),
        ("udp://0.0.0.0:14550", "udpout://HOST:PORT"),
        ("serial://ttyACM0:115200", "serial:///dev/NAME:BAUD expected"),
        ("serial:///dev/ttyACM0", "serial:///dev/NAME:BAUD expected"),
        ("serial:///dev/ttyACM0:fast", "serial:///dev/NAME:BAUD expected"),
        ("serial:///dev/ttyACM0:0", "a baud rate from 1 to 20000000 expected"),
        ("udpin://:14550", "udpin://ADDRESS:PORT expected"),
        ("udpin://0.0.0.0", "udpin://ADDRESS:PORT expected"),
        ("udpin://0.0.0.0:14550/path", "udpin://ADDRESS:PORT expected"),
        ("udpin://::1:14550", "udpin://ADDRESS:PORT expected"),
        ("udpin://0.0.0.0:65536", "port 65536 found"),
        ("udpout://a..b:14550", "udpout://HOST:PORT expected"),
        ("udpout://127.0.0.1:0", "a port from 1 to 65535 expected"),
        ("tcpin://127.0.0.1:-1", "tcpin://ADDRESS:PORT expected"),
        ("tcpout://user@host:5760", "tcpout://HOST:PORT expected"),
        ("tlog://flight.tlog", "tlog:///PATH expected"),
        ("tlog:///var/log/", "tlog:///PATH expected"),
        ("memory://", "memory://NAME expected"),
    ],
)
def test_a_url_that_cannot_be_used_says_what_was_found_and_expected(
    url: str, expected: str
) -> None:
    with pytest.raises(LinkError) as caught:
        open_link(url, "autopilot", no_clock)
    message = str(caught.value)
    assert message.startswith("autopilot: ")
    assert repr(url) in message
    assert expected in message
    assert "\n" not in message
