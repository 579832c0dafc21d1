"""Addresses: wherever one is given it is read alike."""

import pytest
from click.testing import CliRunner

from risaf_link.address import address_in, shown
from risaf_link.cli import main
from risaf_link.config import load
from risaf_link.errors import ConfigError

GOOD = {
    "127.0.0.1:9100": ("127.0.0.1", 9100),
    "localhost:0": ("localhost", 0),
    "ground-station.local:65535": ("ground-station.local", 65535),
    "[::1]:8765": ("::1", 8765),
    "[fe80::1%eth0]:8765": ("fe80::1%eth0", 8765),
}
BAD = ["", "here", ":9100", "here:", "here:65536", "::1:9100", "[here]:1", "a b:1", "http://a:1"]


@pytest.mark.parametrize("text", GOOD)
def test_an_address_is_read_and_shown_again(text):
    assert address_in(text) == GOOD[text]
    assert shown(*GOOD[text]) == text


@pytest.mark.parametrize("text", GOOD)
def test_an_address_is_good_wherever_one_is_given(text):
    link, broker = f"udpin://{text}", f"mqtt://{text}".replace(":0", ":1")  # no broker is on 0
    config = load(None, [f"metrics.listen={text!r}", f"mqtt.url={broker}", f"links.0.url={link}"])
    assert config.metrics.listen == text
    told = CliRunner().invoke(main, ["monitor", "nothing.tlog", "--listen", text])
    assert "nothing.tlog" in told.output


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_address_is_refused_wherever_one_is_given(text):
    assert address_in(text) is None
    for setting in (f"metrics.listen={text or ' '!r}", f"links.0.url={'udpin://' + text!r}"):
        with pytest.raises(ConfigError, match=r"ADDRESS:PORT|port from"):
            load(None, [setting])
    told = CliRunner().invoke(main, ["monitor", "nothing.tlog", "--listen", text])
    assert told.exit_code == 2
    assert "ADDRESS:PORT" in told.output
