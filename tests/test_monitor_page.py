"""The page in a real browser: live from a real service, and from a log."""

import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright, expect
from ports import free_ports
from test_monitor import NOW_US, STATUS
from wire import frame

from risaf_link.links import open_link
from risaf_link.links.play import play
from risaf_link.mavlink.tlog import record
from risaf_link.sim.failures import Dropouts
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames

CHROMIUM = shutil.which("chromium")
SAFETY_S = 60
PHONE, DESK = {"width": 360, "height": 740}, {"width": 1400, "height": 900}

if CHROMIUM is None and "CI" not in os.environ:
    pytest.skip("no chromium: apt-get install chromium", allow_module_level=True)


@asynccontextmanager
async def command(*arguments: str):
    """One of our commands, running; it must end when it is told to."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "risaf_link.cli", *arguments), stderr=subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGINT)
        async with asyncio.timeout(SAFETY_S):
            await process.communicate()
        assert process.returncode in {0, -signal.SIGKILL}


@asynccontextmanager
async def monitor(source: str):
    """The page's program, and where the page is."""
    async with command("monitor", source, "--listen", "127.0.0.1:0") as process:
        async with asyncio.timeout(SAFETY_S):
            line = (await process.stderr.readline()).decode()
        yield process, re.search(r"http://\S+", line)[0]


@asynccontextmanager
async def browsing(url: str, viewport=DESK, scheme="light"):
    """The page in a browser; nothing may go wrong there, or come from elsewhere."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(viewport=viewport, color_scheme=scheme)
        page.set_default_timeout(SAFETY_S * 1000)
        errors, asked = [], []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        await page.goto(url)
        yield page
        assert not errors
        assert asked
        assert all(each.startswith(url) for each in asked)
        await browser.close()


async def until(page: Page, selector: str, pattern: str) -> str:
    """Wait until an element's text matches; the text."""
    place = page.locator(selector).first
    await expect(place).to_have_text(re.compile(pattern), timeout=SAFETY_S * 1000)
    return await place.text_content()


async def kept_screenshot(page: Page, name: str) -> None:
    """A picture to be looked at, where somebody wants one."""
    folder = os.environ.get("RISAF_SCREENSHOTS")
    if folder:
        await page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)


def drive():
    """A drive on which two of forty sensors fall silent, and GPS goes."""
    circle = scenario("circle", seed=3, sensors=40, rate=50, duration=120)
    silence = Dropouts(share=0.05, returning=0.0, absence=1.0, onset=(8.0, 8.5))
    return frames(replace(circle, faults={"dropouts": silence}, outages=((12.0, 120.0),)))


async def test_a_live_service_is_found_and_its_troubles_show():
    vehicle, ground = free_ports(2)
    links = (
        f"{{name: vehicle, url: 'udpin://127.0.0.1:{vehicle}', emit: {{}}}}",
        f"{{name: ground, url: 'udpin://127.0.0.1:{ground}'}}",
    )
    async with (
        command("run", "--set", f"links=[{', '.join(links)}]") as service,
        monitor(f"udpout://127.0.0.1:{ground}") as (program, url),
        browsing(url) as page,
    ):
        await until(page, "#notice", "No risaf_link component is heard yet")
        await until(page, "#heard", "1:191 · onboard computer · boot")
        feeding = asyncio.create_task(
            play(drive(), open_link(f"udpout://127.0.0.1:{vehicle}", "vehicle", lambda: 0))
        )
        await until(page, "#freshness", r"live · last message 0\.\d s ago")
        await until(page, "#heard", "1:191 · risaf_link · active")
        await until(page, "#heard tr td:nth-child(4)", r"^\d+\.\d$")  # the round trip, ms
        await until(page, "#state", "^fusing$")
        first = await until(page, "#yaw", r"\d+\.\d°")
        await expect(page.locator("#yaw")).not_to_have_text(first)
        await until(page, "#rates", r"x.\d+\.\d\d ± .*\d+ ± \d+")  # bias with its deviation
        await expect(page.locator("#cells .cell")).to_have_count(40)
        dead = page.locator("#cells .cell[data-state='2']")
        await dead.nth(1).wait_for()
        await dead.first.hover()
        await until(page, "#sensor", r"Sensor \d+: dead \(silent\)")
        await until(page, "#census", "38 healthy, 0 suspect, 2 dead of 40")
        await until(page, "#state", "dead reckoning")
        await until(page, "#since", r"last fused \d")
        await until(page, "#events", "GPS lost")
        await until(page, "#events", "2 of 40 sensors dead")
        await kept_screenshot(page, "live")
        feeding.cancel()
        service.kill()
        await until(page, "#notice", r"No data for \d+\.\d s: what is shown is old")
        program.kill()
        await until(page, "#notice", "does not answer")
        await asyncio.wait([feeding])


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """What a service told on a drive with an outage of GPS from 20 to 30 s."""
    folder = tmp_path_factory.mktemp("log")
    raw, told = str(folder / "raw.tlog"), str(folder / "told.tlog")
    run = [sys.executable, "-m", "risaf_link.cli"]
    size = ["--seed", "1", "--duration", "40", "--sensors", "30", "--rate", "50"]
    subprocess.run([*run, "simulate", "circle", *size, "--out", raw], check=True)
    outage = ["--outage", "20:30", "--out", told]
    subprocess.run([*run, "replay", raw, *outage], check=True, capture_output=True)
    return told


async def seek(page: Page, seconds: int) -> None:
    await page.locator("#seek").fill(str(seconds))


async def test_a_log_plays_pauses_and_seeks(log):
    async with monitor(log) as (_, url), browsing(url) as page:
        await until(page, "#clock", "^2026-01-01 00:00:.* UTC$")  # the log's time
        await until(page, "#length", "^0:39$")
        await until(page, "#position", "^0:(?!00)")  # it goes on
        await page.click("#play")
        await page.wait_for_selector("#play[data-paused=true]")
        await seek(page, 25)
        await until(page, "#position", "^0:25$")
        await until(page, "#state", "dead reckoning")
        yaw = await page.text_content("#yaw")
        await until(page, "#since", r"last fused [45]\.\d s ago")
        await kept_screenshot(page, "log")
        await seek(page, 10)
        await until(page, "#state", "^fusing$")
        assert await page.text_content("#position") == "0:10"
        assert await page.text_content("#yaw") != yaw
        await page.select_option("#speed", "20")
        await page.click("#play")
        await until(page, "#position", "^0:39$")
        await page.wait_for_selector("#play[data-paused=true]")


@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_it_fits_a_phone_and_follows_its_colours(log, scheme):
    async with monitor(log) as (_, url), browsing(url, PHONE, scheme) as page:
        await seek(page, 25)
        await until(page, "#state", "dead reckoning")
        await expect(page.locator("#cells .cell")).to_have_count(30)
        assert await page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
        ground = await page.evaluate("getComputedStyle(document.body).backgroundColor")
        red, *_ = map(int, re.findall(r"\d+", ground))
        assert (red > 128) == (scheme == "light")
        await kept_screenshot(page, f"phone-{scheme}")


async def test_of_several_vehicles_one_is_chosen(tmp_path):
    log, records = tmp_path / "two.tlog", []
    for second in range(30):
        for system, yaw in ((1, 0.5), (2, 1.0)):
            told = {**STATUS, "yaw": yaw, "fused_count": second}
            raw = frame("GPS_HEADING_STATUS", (system, 191), **told).raw
            records.append(record(NOW_US + second * 1_000_000, raw))
    log.write_bytes(b"".join(records))
    async with monitor(str(log)) as (_, url), browsing(url) as page:
        await until(page, "#yaw", "^28.6°$")
        await page.select_option("#chosen", "2:191")
        await until(page, "#yaw", "^57.3°$")
        await page.select_option("#chosen", "1:191")
        await until(page, "#yaw", "^28.6°$")
