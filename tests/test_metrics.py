"""What Prometheus reads is what was counted, and reading it costs the estimator nothing."""

import asyncio
import contextlib
import socket
import subprocess
import sys
from itertools import pairwise

import pytest
from brokers import SAFETY_S, until
from daemon import EPOCHS, Running, bursts, config_for, feed
from estimates import estimates
from msgspec import structs
from prometheus_client.parser import text_string_to_metric_families

from risaf_link.errors import ConfigError
from risaf_link.mavlink.allowance import Allowance
from risaf_link.publish import scrape
from risaf_link.publish.account import Account, MqttCounts
from risaf_link.publish.metrics import BOUNDS_US, Metrics
from risaf_link.publish.scrape import MetricsParameters
from risaf_link.service import Service

ANYWHERE = MetricsParameters("127.0.0.1:0")


def metered(ground, **sections):
    return structs.replace(config_for(ground), metrics=ANYWHERE, **sections)


async def ask(
    port: int, request: bytes = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n"
) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        async with asyncio.timeout(SAFETY_S):
            return await reader.read()
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def figures(port: int) -> dict[tuple[str, ...], float]:
    """Every sample by its name and the values of its labels, as Prometheus' own parser reads it."""
    head, _, body = (await ask(port)).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert f"Content-Length: {len(body)}".encode() in head
    families = list(text_string_to_metric_families(body.decode()))
    assert len({family.name for family in families}) == len(families)
    assert all(family.documentation for family in families)
    samples = [sample for family in families for sample in family.samples]
    found = {(s.name, *(v for _, v in sorted(s.labels.items()))): s.value for s in samples}
    assert len(found) == len(samples)
    return found


async def port_of(service: Service) -> int:
    (metrics,) = service._outputs.running
    await until(lambda: metrics.page.port)
    return metrics.page.port


async def test_the_page_tells_what_the_service_counted(ground):
    async with Running(metered(ground), up=2) as service:
        port = await port_of(service)
        before = await figures(port)
        assert before["risaf_link_epochs_total",] == 0
        await feed(ground, service, bursts())
        after = await figures(port)
    assert after["risaf_link_epochs_total",] == EPOCHS
    assert after["risaf_link_latency_seconds_count",] == EPOCHS
    assert after["risaf_link_sensors_expected",] == 60
    standing = [after["risaf_link_sensors", state] for state in ("HEALTHY", "SUSPECT", "DEAD")]
    assert sum(standing) == 60
    array, output = service.links
    assert after["risaf_link_link_bytes_total", "in", "array"] == array.counts.bytes_in
    assert after["risaf_link_link_frames_total", "in", "array"] == sum(map(len, bursts()))
    assert after["risaf_link_link_frames_total", "out", "ground"] >= EPOCHS
    assert 0 < after["risaf_link_link_bytes_total", "out", "ground"] <= output.counts.bytes_out
    assert after["risaf_link_link_peers", "array"] == 1
    assert sum(v for name, v in after.items() if name[0] == "risaf_link_heading_state") == 1


async def test_latencies_are_a_histogram_of_what_a_clock_beside_it_says(ground):
    loop = asyncio.get_running_loop()
    async with Running(metered(ground), up=2) as service:
        port, began = await port_of(service), loop.time()
        await feed(ground, service, bursts())
        passed = loop.time() - began
        found = await figures(port)
    bounds = [str(bound / 1e6) for bound in BOUNDS_US] + ["+Inf"]
    buckets = [v for name, v in found.items() if name[0] == "risaf_link_latency_seconds_bucket"]
    assert len(buckets) == len(bounds)
    assert all(a <= b for a, b in pairwise(buckets))
    assert buckets[-1] == EPOCHS
    assert 0 < found["risaf_link_latency_seconds_sum",] < passed


async def test_garbage_and_drops_are_told_by_reason(ground):
    async with Running(metered(ground), up=2) as service:
        port = await port_of(service)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            host, _, number = service.links[0].address.partition(":")
            stranger.sendto(bytes([0xFD, 9]) * 40, (host, int(number)))
        await until(lambda: service.dropped)
        found = await figures(port)
    told = {name[1]: v for name, v in found.items() if name[0] == "risaf_link_frames_dropped_total"}
    assert told == dict(service.dropped)


async def test_what_became_of_mqtt_is_told_by_topic():
    counts = MqttCounts(True, 3, {"events": 5}, {"events": 1}, {"events": 2})
    account = Account({}, {"radio: replayed": 7}, {}, {}, [])
    metrics = Metrics(ANYWHERE, lambda: account, lambda: counts)
    task = asyncio.create_task(metrics.run())
    await until(lambda: metrics.page.port)
    found = await figures(metrics.page.port)
    task.cancel()
    await asyncio.wait([task])
    assert found["risaf_link_mqtt_up",] == 1
    assert found["risaf_link_mqtt_connections_total",] == 3
    told = [found[f"risaf_link_mqtt_{n}", "events"] for n in ("published_total", "dropped_total")]
    assert [*told, found["risaf_link_mqtt_waiting", "events"]] == [5, 1, 2]
    assert found["risaf_link_frames_rejected_total", "radio", "replayed"] == 7


async def test_innovations_and_deviations_are_those_of_the_last_estimate():
    metrics = Metrics(ANYWHERE, lambda: Account({}, {}, {}, {}, []))
    task = asyncio.create_task(metrics.run())
    await until(lambda: metrics.page.port)
    for estimate in estimates():
        metrics.take(estimate, 0, 0, 0)
    found = await figures(metrics.page.port)
    task.cancel()
    await asyncio.wait([task])
    innovation = estimate.heading.innovation
    assert found["risaf_link_heading_innovation_radians",] == pytest.approx(innovation.value)
    assert found["risaf_link_heading_test_ratio",] == pytest.approx(innovation.test_ratio)
    assert found["risaf_link_attitude_std_radians", "yaw"] == estimate.attitude.yaw_std
    assert found["risaf_link_heading_fused_total",] == estimate.heading.fused_count


async def test_who_asks_and_does_not_go_on_costs_no_epoch(ground):
    async with Running(metered(ground), up=2) as service, contextlib.AsyncExitStack() as stack:
        port = await port_of(service)
        for k in range(scrape.MOST_AT_ONCE):
            idle = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            idle.sendall(b"GET /metrics HTTP/1.1\r\n" + b"\r\n" * (k % 2))  # half never end
        (metrics,) = service._outputs.running
        await until(lambda: len(metrics.page._answering) >= scrape.MOST_AT_ONCE // 2)
        assert len(await feed(ground, service, bursts())) == EPOCHS


async def test_who_takes_too_long_is_left(monkeypatch):
    monkeypatch.setattr(scrape, "PATIENCE_S", 0.01)
    metrics = Metrics(ANYWHERE, lambda: Account({}, {}, {}, {}, []))
    task = asyncio.create_task(metrics.run())
    await until(lambda: metrics.page.port)
    assert await ask(metrics.page.port, b"GET /metrics") == b""
    await until(lambda: not metrics.page._answering)
    task.cancel()
    await asyncio.wait([task])


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"404 Not Found"),
        (b"POST /metrics HTTP/1.1\r\nContent-Length: 0\r\n\r\n", b"405 Method Not Allowed"),
        (b"GET /metrics?name=x HTTP/1.0\r\n\r\n", b"200 OK"),
        (b"HEAD /metrics HTTP/1.1\r\n\r\n", b"200 OK"),
        (b"\x16\x03\x01\r\n\r\n", b"405 Method Not Allowed"),
        (b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:9100\r\n\r\n", b"200 OK"),
        (b"GET /metrics HTTP/1.1\r\nhOST: rebound.example\r\n\r\n", b"403 Forbidden"),
    ],
)
async def test_it_is_read_and_nothing_else(request_, status):
    metrics = Metrics(ANYWHERE, lambda: Account({}, {}, {}, {}, []))
    task = asyncio.create_task(metrics.run())
    await until(lambda: metrics.page.port)
    answer = await ask(metrics.page.port, request_)
    task.cancel()
    await asyncio.wait([task])
    assert answer.split(b"\r\n")[0] == b"HTTP/1.1 " + status
    if request_.startswith(b"HEAD"):
        assert answer.endswith(b"\r\n\r\n")


async def test_who_asks_all_the_time_is_told_to_ask_less_often():
    metrics = Metrics(ANYWHERE, lambda: Account({}, {}, {}, {}, []))
    task = asyncio.create_task(metrics.run())
    await until(lambda: metrics.page.port)
    metrics.page._allowance = Allowance(rate=0.001, most=2)
    answers = [(await ask(metrics.page.port)).split(b"\r\n")[0] for _ in range(3)]
    task.cancel()
    await asyncio.wait([task])
    assert answers == [*[b"HTTP/1.1 200 OK"] * 2, b"HTTP/1.1 429 Too Many Requests"]


async def test_a_port_that_is_taken_is_told_once_and_the_service_goes_on(
    ground,
    caplog,
    monkeypatch,
):
    monkeypatch.setattr(scrape, "AGAIN_S", 0.001)
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        config = structs.replace(config_for(ground), metrics=MetricsParameters(taken))
        async with Running(config, up=2) as service:
            assert len(await feed(ground, service, bursts())) == EPOCHS
            await until(lambda: any("metrics" in message for message in caplog.messages))
    told = [message for message in caplog.messages if message.startswith("metrics")]
    assert told == [f"metrics: down: {taken}: Address already in use"]


async def test_an_output_that_fails_ends_alone(ground, caplog):
    async with Running(metered(ground), up=2) as service:
        (metrics,) = service._outputs.running
        before = service._outputs.running
        metrics.take = None  # whatever goes wrong in it
        assert len(await feed(ground, service, bursts())) == EPOCHS
        assert (len(before), service._outputs.running) == (1, [])
    assert caplog.messages.count("Metrics has failed and is left out") == 1


def test_without_the_extra_it_says_what_to_install(ground, monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "risaf_link.publish.metrics")
    with pytest.raises(ConfigError, match=r"metrics\.listen: .* with the extra `metrics`"):
        Service(metered(ground))


def test_neither_library_is_imported_by_those_who_do_not_use_it():
    program = (
        "import sys; from risaf_link.config import Config; from risaf_link.service import Service; "
        "Service(Config()); print({'aiomqtt', 'prometheus_client'} & set(sys.modules))"
    )
    ended = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    assert ended.stdout.strip() == b"set()"
