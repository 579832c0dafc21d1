"""What is published over MQTT, against real brokers: nothing told is lost, nothing waits for it."""

import asyncio
import contextlib
import logging
import math
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
import trustme
from brokers import SAFETY_S, Amqtt, Listener, Mosquitto, Proxy, until
from daemon import EPOCHS, Running, bursts, config_for, feed
from estimates import estimates
from msgspec import structs
from ports import free_port

from risaf_link.core.rotation import euler_from_quaternion
from risaf_link.mavlink.notices import Notice, Severity
from risaf_link.publish import connection
from risaf_link.publish.access import PASSWORD, MqttParameters, MqttRates
from risaf_link.publish.mqtt import MqttPublisher, Pauses

QUICK = Pauses(0.001, 0.01)
NOTICE = Notice(Severity.INFO, "samples are back")


def parameters(port: int, **keys) -> MqttParameters:
    return MqttParameters(**{"url": f"mqtt://127.0.0.1:{port}", "vehicle": "v", **keys})


@contextlib.asynccontextmanager
async def publishing(chosen: MqttParameters, up: bool = True):
    """A publisher that runs; unless told otherwise, one that the broker has taken in."""
    publisher = MqttPublisher(chosen, QUICK)
    task = asyncio.create_task(publisher.run())
    try:
        if up:
            await until(lambda: publisher.counts().is_up or task.done())
        yield publisher
    finally:
        task.cancel()
        async with asyncio.timeout(SAFETY_S):
            await asyncio.wait([task])
        assert task.cancelled(), task.exception()


@contextlib.asynccontextmanager
async def running(broker):
    await broker.start()
    try:
        yield broker
    finally:
        broker.kill()


@pytest.fixture(autouse=True)
def _impatience(monkeypatch):
    """Do not wait long for amqtt, which does not answer who comes with MQTT 5 and a last will."""
    monkeypatch.setattr(connection, "ANSWER_S", 1.0)


@pytest.fixture(params=[Mosquitto, Amqtt], ids=["mosquitto", "amqtt"])
async def broker(request, tmp_path):
    async with running(request.param(tmp_path)) as one:
        yield one


@pytest.fixture
async def mosquitto(tmp_path):
    async with running(Mosquitto(tmp_path)) as one:
        yield one


def take_all(publisher: MqttPublisher, several) -> None:
    for estimate in several:
        publisher.take(estimate, 1_700_000_000_000_000 + estimate.time_us, 0, 0)


def numbers(listener: Listener) -> list[int]:
    return [event["number"] for event in listener.of("events")]


class TestWhatIsPublished:
    async def test_who_comes_later_finds_the_last_state_and_that_we_are_there(self, broker):
        async with publishing(parameters(broker.port)) as publisher:
            take_all(publisher, estimates())
            counts = {"attitude": 10, "heading": 4, "array": 2, "sensors": 1, "events": 0}
            await until(lambda: publisher.counts().published == counts)
            async with Listener(broker.port) as late:
                await until(lambda: late.count == 5)
        assert [state["state"] for state in late.retained("availability")] == ["online"]
        last = next(e for e in estimates() if e.elapsed >= 1.8)
        for topic in ("attitude", "heading"):
            (told,) = late.retained(topic)
            assert told["unix_us"] - 1_700_000_000_000_000 == pytest.approx(
                last.time_us, abs=310_000
            )

    async def test_what_is_told_is_what_was_estimated(self, mosquitto):
        all_at_once = MqttRates(1000.0, 1000.0, 1000.0, 1000.0)
        estimate = estimates()[-1]
        async with (
            Listener(mosquitto.port) as listener,
            publishing(parameters(mosquitto.port, rates=all_at_once)) as publisher,
        ):
            publisher.take(estimate, 77, 0, 0)
            publisher.tell(Notice(Severity.WARNING, "GPS lost"), 5, 6)
            await until(lambda: listener.count == 6)
        (attitude,), (heading,) = listener.of("attitude"), listener.of("heading")
        (array,), (sensors,) = listener.of("array"), listener.of("sensors")
        for told in (attitude, heading, array, sensors):
            assert (told["schema"], told["time_us"], told["unix_us"]) == (1, estimate.boot_us, 77)
        angles = [attitude[f"{name}_rad"] for name in ("roll", "pitch", "yaw")]
        expected = euler_from_quaternion(np.array(attitude["q_nb"]))
        np.testing.assert_allclose(angles, expected, atol=2e-6)
        np.testing.assert_allclose(attitude["q_nb"], estimate.attitude.q_nb, atol=1e-8)
        np.testing.assert_allclose(attitude["rate_b_rad_s"], estimate.attitude.rate_b, atol=1e-8)
        assert heading["state"] == estimate.heading.state.name
        assert heading["test_ratio"] == pytest.approx(
            abs(heading["innovation_rad"]) / (3.0 * heading["innovation_std_rad"]), abs=1e-3
        )
        assert array["healthy"] + array["suspect"] + array["dead"] == array["sensors"] == 5
        assert sensors["state"].count("HEALTHY") == array["healthy"]
        assert np.shape(sensors["relative_bias_rad_s"]) == (5, 3)
        (event,) = listener.of("events")
        assert (event["severity"], event["text"], event["number"]) == ("WARNING", "GPS lost", 1)
        assert (event["time_us"], event["unix_us"]) == (5, 6)
        assert not listener.retained("events")

    async def test_what_is_not_known_is_null(self, mosquitto):
        first = estimates()[0]
        assert math.isnan(first.heading.time_since_fused) or not first.attitude.aligned
        async with (
            Listener(mosquitto.port) as listener,
            publishing(parameters(mosquitto.port)) as publisher,
        ):
            publisher.take(first, 0, 0, 0)
            await until(lambda: listener.of("heading") and listener.of("attitude"))
        (heading,), (attitude,) = listener.of("heading"), listener.of("attitude")
        assert (attitude["yaw_rad"] is None) == (not first.attitude.aligned)
        assert (heading["since_fused_s"] is None) == math.isnan(first.heading.time_since_fused)

    @pytest.mark.parametrize(("rate", "count"), [(0.0, 0), (0.5, 1), (5.0, 5), (1000.0, 1000)])
    def test_a_topic_keeps_its_rate_whatever_the_arrays(self, rate, count):
        only = MqttRates(rate, 0.0, 0.0, 0.0)
        publisher = MqttPublisher(parameters(1, rates=only, states_kept=10_000))
        take_all(publisher, estimates(1.0, 2, 1000.0))
        assert publisher.counts().waiting.get("attitude", 0) == pytest.approx(count, abs=1)

    async def test_home_assistant_is_told_only_where_it_is_wanted(self, mosquitto):
        for prefix in ("", "homeassistant"):
            async with (
                Listener(mosquitto.port) as listener,
                publishing(parameters(mosquitto.port, discovery=prefix)),
            ):
                await until(lambda heard=listener: heard.of("availability"))
                await until(lambda p=prefix, heard=listener: not p or heard.of("config"))
            assert bool(listener.of("config")) == bool(prefix)
        (config,) = listener.of("config")
        assert config["availability_topic"] == "risaf/v/availability"
        assert config["origin"]["name"] == "risaf_link"
        for key, sensor in config["components"].items():
            assert sensor["platform"] == "sensor"
            assert sensor["unique_id"] == key
            topic = sensor["state_topic"].removeprefix("risaf/v/")
            assert topic in {"attitude", "heading", "array"}

    async def test_it_says_goodbye_itself(self, mosquitto):
        async with Listener(mosquitto.port) as listener:
            async with publishing(parameters(mosquitto.port)) as publisher:
                publisher.tell(NOTICE, 0, 0)
            await until(lambda: len(listener.of("availability")) == 2)
        assert [told["state"] for told in listener.of("availability")] == ["online", "offline"]
        assert numbers(listener) == [1]


class TestNothingToldIsLost:
    async def test_a_broker_that_is_killed_and_comes_back(self, mosquitto):
        async with (
            Listener(mosquitto.port) as listener,
            publishing(parameters(mosquitto.port, events_kept=100_000)) as publisher,
        ):
            await mosquitto.store_sessions()
            for round_ in range(3):
                for _ in range(200):
                    publisher.tell(NOTICE, 0, 0)
                    await asyncio.sleep(0)
                if round_ < 2:
                    await until(lambda n=round_: publisher.counts().connections > n)
                    mosquitto.kill()
                    for _ in range(200):
                        publisher.tell(NOTICE, 0, 0)
                    await mosquitto.start()
            await until(lambda: set(numbers(listener)) == set(range(1, 1001)))
            await until(lambda: publisher.counts().waiting["events"] == 0)
            assert publisher.counts().connections >= 3
            assert publisher.counts().dropped["events"] == 0

    async def test_connections_that_are_cut_again_and_again(self, mosquitto):
        async with (
            Listener(mosquitto.port) as listener,
            Proxy(mosquitto.port) as proxy,
            publishing(parameters(proxy.port, events_kept=100_000)) as publisher,
        ):
            for k in range(20):
                for _ in range(20):
                    publisher.tell(NOTICE, 0, 0)
                until_cut = proxy.connections + k % 2  # now and then one that just begins
                await until(lambda n=until_cut: proxy.connections >= n)
                for _ in range(7 * k):  # some way into the handshake, the greeting, the events
                    await asyncio.sleep(0)
                proxy.cut()
            await until(lambda: set(numbers(listener)) == set(range(1, 401)))
            await until(lambda: publisher.counts().waiting["events"] == 0)
        assert proxy.connections > 5

    async def test_events_beyond_what_is_kept_are_counted_and_seen_to_be_missing(self, mosquitto):
        mosquitto.kill()
        async with publishing(parameters(mosquitto.port, events_kept=10), up=False) as publisher:
            for _ in range(25):
                publisher.tell(NOTICE, 0, 0)
            assert publisher.counts().dropped["events"] == 15
            await mosquitto.start()
            async with Listener(mosquitto.port) as listener:
                publisher.tell(NOTICE, 0, 0)
                await until(lambda: 26 in numbers(listener) or publisher.counts().is_up)
            await until(lambda: publisher.counts().waiting["events"] == 0)
            counts = publisher.counts()
        assert counts.published["events"] + counts.dropped["events"] == 26

    async def test_the_state_is_there_again_in_a_broker_that_has_forgotten_it(self, mosquitto):
        async with publishing(parameters(mosquitto.port)) as publisher:
            take_all(publisher, estimates())
            await until(lambda: not any(publisher.counts().waiting.values()))
            mosquitto.kill()
            mosquitto.store.unlink(missing_ok=True)
            await mosquitto.start()
            async with Listener(mosquitto.port) as listener:
                topics = ("attitude", "heading", "array", "sensors", "availability")
                await until(lambda: all(listener.of(topic) for topic in topics))


class TestTheServiceGoesOn:
    """Every epoch is answered, whatever the broker does."""

    async def every_epoch_is_answered(self, ground, port: int) -> None:
        chosen = parameters(port, rates=MqttRates(attitude=1000.0))
        config = structs.replace(config_for(ground), mqtt=chosen)
        async with Running(config, up=2) as service:
            assert len(await feed(ground, service, bursts())) == EPOCHS
            (publisher,) = service._outputs.running
            waiting = publisher.counts().waiting
            assert waiting["attitude"] <= config.mqtt.states_kept
            assert waiting["attitude"] + publisher.counts().dropped["attitude"] == EPOCHS

    async def test_without_a_broker(self, ground):
        await self.every_epoch_is_answered(ground, free_port(socket.SOCK_STREAM))

    async def test_with_one_that_takes_connections_and_never_answers(self, ground):
        with socket.create_server(("127.0.0.1", 0)) as silent:
            await self.every_epoch_is_answered(ground, silent.getsockname()[1])

    async def test_a_slow_broker_gets_the_newest_and_the_oldest_are_counted(
        self, mosquitto, monkeypatch
    ):
        monkeypatch.setattr(connection, "ANSWER_S", SAFETY_S)
        rates = MqttRates(0.0, 0.0, 0.0, 1000.0)  # large ones
        several = iter(estimates(1.0, 150, 1000.0))
        async with (
            Listener(mosquitto.port) as listener,
            Proxy(mosquitto.port) as proxy,
            publishing(parameters(proxy.port, rates=rates)) as publisher,
        ):
            proxy.flowing.clear()
            while not publisher.counts().dropped["sensors"]:
                last = next(several)
                publisher.take(last, 0, 0, 0)
                for _ in range(50):  # turns in which it may go out
                    await asyncio.sleep(0)
            assert publisher.counts().published["sensors"] > 5  # until all buffers were full
            assert publisher.counts().waiting["sensors"] <= publisher._parameters.states_kept
            proxy.flowing.set()
            await until(lambda: publisher.counts().waiting["sensors"] == 0)
            newest = last.boot_us
            await until(lambda: any(t["time_us"] == newest for t in listener.of("sensors")))
        counts = publisher.counts()
        assert len(listener.of("sensors")) == counts.published["sensors"]
        assert counts.connections == 1


class TestGettingIn:
    @pytest.fixture
    async def guarded(self, tmp_path):
        passwords = tmp_path / "passwords"
        tool = ["mosquitto_passwd", "-b", "-c", str(passwords), "rover", "right"]
        broker = Mosquitto(tmp_path, "allow_anonymous false", f"password_file {passwords}")
        subprocess.run(tool, check=True, capture_output=True)  # noqa: ASYNC221 it is quick
        passwords.chmod(0o644)
        async with running(broker) as one:
            yield one

    async def test_a_password_from_a_file(self, guarded, tmp_path):
        secret = tmp_path / "secret"
        secret.touch(0o600)
        secret.write_text("right\n")
        chosen = parameters(guarded.port, user="rover", password_file=str(secret))
        async with publishing(chosen) as publisher:
            assert publisher.counts().is_up

    async def test_a_password_from_the_environment(self, guarded, monkeypatch):
        monkeypatch.setenv(PASSWORD, "right")
        async with publishing(parameters(guarded.port, user="rover")) as publisher:
            assert publisher.counts().is_up

    async def test_a_wrong_password_is_told_once_and_tried_again(
        self, guarded, monkeypatch, caplog
    ):
        monkeypatch.setenv(PASSWORD, "wrong")
        async with (
            Proxy(guarded.port) as proxy,
            publishing(parameters(proxy.port, user="rover"), up=False),
        ):
            await until(lambda: proxy.connections >= 4)
        lines = [record.message for record in caplog.records if record.name.startswith("risaf")]
        assert lines == [f"mqtt: down: 127.0.0.1:{proxy.port}: refused: Not authorized"]

    async def test_going_and_coming_is_one_line_each(self, mosquitto, caplog):
        caplog.set_level(logging.INFO)
        async with publishing(parameters(mosquitto.port)) as publisher:
            mosquitto.kill()
            await until(lambda: not publisher.counts().is_up)
            await mosquitto.start()
            await until(lambda: publisher.counts().connections == 2)
        lines = [record.message for record in caplog.records if record.name.startswith("risaf")]
        where = f"127.0.0.1:{mosquitto.port}"
        assert lines[0] == lines[-1] == f"mqtt: up: {where}, MQTT 5"
        downs = lines[1:-1]
        assert 1 <= len(downs) <= 3  # connection lost, then refused by the system
        assert all(line.startswith(f"mqtt: down: {where}: ") for line in downs)
        assert len(set(downs)) == len(downs)

    async def test_an_older_broker_is_spoken_to_in_its_own_version(self, tmp_path, caplog):
        caplog.set_level(logging.INFO)
        async with running(Amqtt(tmp_path)) as broker, publishing(parameters(broker.port)):
            pass
        assert f"mqtt: up: 127.0.0.1:{broker.port}, MQTT 3.1.1" in caplog.messages


class TestTls:
    @pytest.fixture
    def authority(self):
        return trustme.CA()

    @pytest.fixture
    async def secure(self, authority, tmp_path):
        """Wants a certificate of ours, too."""
        server = authority.issue_cert("127.0.0.1", "localhost")
        authority.cert_pem.write_to_path(tmp_path / "ca.pem")
        server.private_key_pem.write_to_path(tmp_path / "server.key")
        chain = b"".join(blob.bytes() for blob in server.cert_chain_pems)
        (tmp_path / "server.pem").write_bytes(chain)
        lines = (
            f"cafile {tmp_path}/ca.pem",
            f"certfile {tmp_path}/server.pem",
            f"keyfile {tmp_path}/server.key",
            "require_certificate true",
            "use_identity_as_username true",
        )
        async with running(Mosquitto(tmp_path, *lines)) as one:
            yield one

    def chosen(self, authority, broker, tmp_path, **keys) -> MqttParameters:
        ours = authority.issue_cert("rover.local", common_name="rover")
        (tmp_path / "own.key").touch(0o600)
        (tmp_path / "own.key").write_bytes(ours.private_key_pem.bytes())
        (tmp_path / "own.pem").write_bytes(ours.cert_chain_pems[0].bytes())
        told = {
            "url": f"mqtts://127.0.0.1:{broker.port}",
            "ca": f"{tmp_path}/ca.pem",
            "certificate": f"{tmp_path}/own.pem",
            "key": f"{tmp_path}/own.key",
        }
        return parameters(broker.port, **{**told, **keys})

    async def test_with_a_certificate_of_our_own(self, authority, secure, tmp_path):
        async with publishing(self.chosen(authority, secure, tmp_path)) as publisher:
            publisher.tell(NOTICE, 0, 0)
            await until(lambda: publisher.counts().published["events"] == 1)

    @pytest.mark.filterwarnings(  # paho leaves such a socket to the garbage collector
        "ignore:unclosed <ssl:ResourceWarning", "ignore:Exception ignored in. <ssl:Warning"
    )
    async def test_a_broker_that_nobody_vouches_for_gets_nothing(
        self, authority, secure, tmp_path, caplog
    ):
        trustme.CA().cert_pem.write_to_path(tmp_path / "other.pem")
        chosen = self.chosen(authority, secure, tmp_path, ca=f"{tmp_path}/other.pem")
        async with publishing(chosen, up=False) as publisher:
            await until(lambda: any("CERTIFICATE_VERIFY_FAILED" in m for m in caplog.messages))
            assert publisher.counts().connections == 0


class TestTheRealProcess:
    async def test_the_broker_says_that_it_was_killed(self, broker, ground):
        links = f"links=[{{name: ground, url: 'udpout://127.0.0.1:{ground.port}'}}]"
        mqtt = f"mqtt={{url: 'mqtt://127.0.0.1:{broker.port}', vehicle: v}}"
        command = [sys.executable, "-m", "risaf_link.cli", "run", "--set", links, "--set", mqtt]
        async with Listener(broker.port) as listener:
            daemon = await asyncio.create_subprocess_exec(*command)
            await until(lambda: listener.of("availability"))
            daemon.send_signal(signal.SIGKILL)
            await daemon.wait()
            await until(lambda: len(listener.of("availability")) == 2)
        assert [told["state"] for told in listener.of("availability")] == ["online", "offline"]
