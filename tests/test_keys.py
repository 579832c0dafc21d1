"""Keys and their clocks, in files."""

import os
import stat
from pathlib import Path

import msgspec
import pytest
import yaml
from daemon import (
    EPOCHS,
    Running,
    address_of,
    bursts,
    config_for,
    feed,
    until,
)
from streams import KEY, parsed
from test_signing import OTHER_KEY, setup, signed
from wire import frame

from risaf_link.config import Config, dump, load
from risaf_link.errors import ConfigError
from risaf_link.keys import KeyFile, open_keys
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.signing import (
    RESERVE,
    LinkSigning,
    SigningKey,
    SigningParameters,
    SigningState,
    setup_in,
)
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.service import Service

NOW_US = 1_800_000_000_000_000


def key_file(directory: Path, content: bytes = KEY, mode: int = 0o600) -> Path:
    path = directory / "signing.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


def config(path: Path, **signing: object) -> Config:
    one = {"name": "a", "url": "udpin://127.0.0.1:0", "signing": {"key": str(path), **signing}}
    return load(None, [f"links={yaml.safe_dump([one], default_flow_style=True)}"])


def stored(path: Path) -> SigningState:
    return msgspec.json.decode(Path(f"{path}.state").read_bytes(), type=SigningState)


@pytest.mark.parametrize(
    "content", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"], ids=len
)
def test_a_key_is_32_bytes_or_64_digits(tmp_path, content):
    keys = open_keys(config(key_file(tmp_path, content)))
    assert keys.links["a"].accepts(signed(1))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644, 0o610])
def test_a_key_that_others_may_read_is_refused(tmp_path, mode):
    path = key_file(tmp_path, mode=mode)
    with pytest.raises(ConfigError) as refused:
        open_keys(config(path))
    assert str(refused.value) == (
        f"links.0.signing.key: {path}: found signing.key with mode {mode:04o}, "
        "expected 0600 or 0400: readable by its owner alone"
    )


def test_a_file_that_is_no_key_is_not_read_to_its_end(tmp_path):
    path = key_file(tmp_path)
    os.truncate(path, 10**9)
    with pytest.raises(ConfigError, match="found more than 65536 bytes, expected a secret"):
        open_keys(config(path))


def test_nothing_that_is_printed_shows_a_secret(tmp_path):
    key = SigningKey(KEY)
    offered = setup_in(frame("SETUP_SIGNING", (255, 190), **setup(OTHER_KEY)))
    key.replace(offered.secret, offered.ticks)
    file = KeyFile(tmp_path / "signing.key", key)
    for shown in (key, key.snapshot(), offered, file, open_keys(config(key_file(tmp_path)))):
        for text in (repr(shown), str(shown)):
            for secret in (KEY, OTHER_KEY):
                assert secret.hex() not in text
                assert repr(secret)[2:-1] not in text


def test_a_key_that_belongs_to_another_is_refused(tmp_path, monkeypatch):
    path = key_file(tmp_path)
    os.chown(path, 1234, -1) if os.geteuid() == 0 else monkeypatch.setattr(os, "geteuid", lambda: 1)
    with pytest.raises(ConfigError, match=r"found signing\.key owned by user "):
        open_keys(config(path))


@pytest.mark.parametrize(
    "content", [b"", KEY[1:], KEY + b"\n", KEY.hex().encode()[2:], b"z" * 64, bytes(32), b"0" * 64]
)
def test_what_is_no_key_is_refused_and_not_shown(tmp_path, content):
    path = key_file(tmp_path, content)
    with pytest.raises(ConfigError) as refused:
        open_keys(config(path))
    assert str(refused.value) == (
        f"links.0.signing.key: {path}: found something else, "
        "expected 32 bytes or 64 hexadecimal digits, not all zero"
    )


def test_a_key_may_be_missing_only_where_it_may_be_set_up(tmp_path):
    path = tmp_path / "signing.key"
    with pytest.raises(ConfigError, match="found no file"):
        open_keys(config(path))
    assert not open_keys(config(path, setup=True)).links["a"].key.is_set


def test_links_with_one_key_share_its_streams_and_have_ids_of_their_own(tmp_path):
    signing = f"signing: {{key: '{key_file(tmp_path)}'}}"
    urls = [f"{{name: l{i}, url: 'udpin://127.0.0.1:0', {signing}}}" for i in range(2)]
    keys = open_keys(load(None, [f"links=[{', '.join(urls)}]"]))
    assert keys.links["l0"].accepts(signed(5))
    assert not keys.links["l1"].accepts(signed(5))
    assert [signing.sign(b"")[0] for signing in keys.links.values()] == [0, 1]


@pytest.mark.parametrize(
    ("signing", "message"),
    [
        ("{}", "links.0.signing.key: found nothing, expected a value"),
        ("{key: k, sing: true}", "links.0.signing.sing: unknown key; known: key, link_id, sign, "),
        ("{key: k, link_id: 256}", "links.0.signing.link_id: found 256, expected int <= 255"),
        (
            "{key: k, accept_unsigned: [HEARTBEAT, BEAT]}",
            "links.0.signing.accept_unsigned.1: found 'BEAT', expected a MAVLink message's name",
        ),
    ],
)
def test_what_is_wrong_with_signing_is_said(signing, message):
    with pytest.raises(ConfigError) as refused:
        load(None, [f"links=[{{name: a, url: 'udpin://1.2.3.4:1', signing: {signing}}}]"])
    assert str(refused.value).startswith(message)


def test_a_recording_is_not_signed(tmp_path):
    with pytest.raises(ConfigError, match=r"links\.0\.signing: found it of a recording"):
        load(None, [f"links=[{{name: a, url: 'tlog://{tmp_path}/a', signing: {{key: k}}}}]"])


def test_the_clock_outlasts_restarts_and_is_stored_whole_and_private(tmp_path):
    path = key_file(tmp_path)
    keys = open_keys(config(path))
    keys.advance(NOW_US)
    keys.open()
    first = stored(path)
    assert first.ticks == keys.links["a"].key.ticks + RESERVE
    state = Path(f"{path}.state")
    assert stat.S_IMODE(state.stat().st_mode) == 0o600
    assert not list(tmp_path.glob("*.new"))
    cut = open_keys(config(path)).links["a"].key  # the power was cut
    cut.advance(0)
    assert cut.ticks == first.ticks
    keys.links["a"].accepts(signed(keys.links["a"].key.ticks + 7))
    keys.close()
    assert stored(path) == keys.links["a"].key.snapshot(is_last=True).state


def test_a_clock_is_stored_before_its_reserve_is_used_up(tmp_path):
    path = key_file(tmp_path)
    keys = open_keys(config(path))
    keys.advance(NOW_US)
    keys.open()
    assert not keys.is_due(0.0)
    keys.advance(NOW_US + 20_000_000)
    assert keys.is_due(20.0)


def test_a_clock_that_cannot_be_stored_keeps_the_service_from_starting(tmp_path):
    path = key_file(tmp_path)
    keys = open_keys(config(path))
    Path(f"{path}.state.new").mkdir()
    with pytest.raises(ConfigError, match=r"signing.key.state: .*: a signing key's clock has to"):
        keys.open()


@pytest.mark.parametrize("damage", [b'{"ticks": -1}', b'{"ti\xdb": 1}', b""])
def test_a_damaged_state_is_told_and_left_out(tmp_path, caplog, damage):
    path = key_file(tmp_path)
    state = Path(f"{path}.state")
    state.touch(0o600)
    state.write_bytes(damage)
    assert open_keys(config(path)).links["a"].key.ticks == 0
    assert "found signing.key.state damaged" in caplog.text


async def test_a_key_that_is_set_up_is_kept_and_nowhere_else(ground, tmp_path, caplog):
    path, recording = tmp_path / "signing.key", tmp_path / "drive.tlog"
    signing = f"signing: {{key: '{path}', setup: true}}"
    whole = config_for(
        ground,
        f"{{name: setup, url: 'udpin://127.0.0.1:0', emit: {{}}, {signing}}}",
        f"{{name: recording, url: 'tlog://{recording}'}}",
    )
    async with Running(whole, up=4) as service:
        assert isinstance(service, Service)
        host, _, port = service.links[2].address.partition(":")
        offered = frame("SETUP_SIGNING", (255, 190), **setup(OTHER_KEY))
        ground.transport.sendto(offered.raw, (host, int(port)))
        ground.transport.sendto(offered.raw, address_of(service))  # not configured there
        await until(path.exists)
    assert path.read_bytes() == OTHER_KEY.hex().encode() + b"\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    recorded = recording.read_bytes()
    assert [one for one in TlogReader([recorded]) if one.frame.message_id == 256] == []
    for place in (recorded.hex(), caplog.text, dump(whole)):
        assert OTHER_KEY.hex() not in place
    assert open_keys(whole).links["setup"].accepts(signed(stored(path).ticks, key=OTHER_KEY))


async def test_what_is_rejected_is_neither_used_nor_recorded(ground, tmp_path):
    path, recording = key_file(tmp_path), tmp_path / "drive.tlog"
    whole = config_for(
        ground,
        f"{{name: safe, url: 'udpin://127.0.0.1:0', emit: {{}}, signing: {{key: '{path}'}}}}",
        f"{{name: recording, url: 'tlog://{recording}', emit: {{}}}}",
    )
    async with Running(whole, up=4) as service:
        host, _, port = service.links[2].address.partition(":")
        good = signed(stored(path).ticks)
        for raw in (frame("GPS_RAW_INT").raw, signed(1, key=OTHER_KEY).raw, good.raw, good.raw):
            ground.transport.sendto(raw, (host, int(port)))
        await until(lambda: sum(service.rejected.values()) == 3)
        assert service.rejected == {
            "safe: unsigned": 1,
            "safe: signature": 1,
            "safe: replayed": 1,
        }
    recorded = [one.frame.raw for one in TlogReader([recording.read_bytes()])]
    assert recorded == [good.raw]


async def test_a_signed_array_is_taken_whole_and_an_unsigned_one_not_at_all(ground, tmp_path):
    signing = {"key": str(key_file(tmp_path))}
    whole = config_for(ground)
    array, output = whole.links
    parameters = SigningParameters(**signing)
    whole = msgspec.structs.replace(
        whole, links=(msgspec.structs.replace(array, signing=parameters), output)
    )
    async with Running(whole, up=2) as service:
        unsigned = bursts(epochs=5)
        for raw in (raw for burst in unsigned for raw in burst):
            ground.transport.sendto(raw, address_of(service))
        sender = LinkSigning(SigningKey(KEY, stored(Path(signing["key"]))), 9, parameters)
        signed_bursts = [[resigned(raw, sender) for raw in burst] for burst in bursts()]
        assert len(await feed(ground, service, signed_bursts)) == EPOCHS
        assert service.rejected == {"array: unsigned": sum(map(len, unsigned))}
        assert service.account().assembly["epochs"] == EPOCHS


def resigned(raw: bytes, sender: LinkSigning) -> bytes:
    ((one,), _) = parsed([raw])
    ids = one.sequence, one.system, one.component
    return encode(one.message_id, one.payload, *ids, sender.sign)
