"""`climategs view` in a headless Chromium: what the browser has got, and what it asks for.

Skipped where there is no Chromium. It draws without a GPU here, slowly.
"""

from __future__ import annotations

import base64
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from augment.output.store import open_store
from augment.view.render_view import render_view
from tests.streets import SMALL_STREET
from tests.tools.test_view import SCALE, hostile_output, rendered, served
from tools.view.edits import Edits
from tools.view.outputs import OutputViewer
from tools.view.server import import_viser, serve

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine"),
]
WAIT_MS = 120_000
# The background's image as the page got it, as a PNG in base 64; null while there is none.
IMAGE = """() => {
  const own = window.__viserMutable?.backgroundMaterial?.uniforms.colorMap.value?.image;
  if (!own) return null;
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [own.width, own.height];
  canvas.getContext("2d").drawImage(own, 0, 0);
  return canvas.toDataURL("image/png").split(",")[1];
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[sync_api.Browser]:
    with sync_api.sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield browser
        browser.close()


def opened(browser: sync_api.Browser, url: str) -> sync_api.Page:
    page = browser.new_page(viewport={"width": 1000, "height": 500})
    page.set_default_timeout(WAIT_MS)
    page.goto(url)
    at_rest(page)
    return page


def at_rest(page: sync_api.Page) -> None:
    page.wait_for_function("() => document.body.innerText.includes('at rest')")
    page.wait_for_timeout(1500)
    page.wait_for_function("() => document.body.innerText.includes('at rest')")


def image_of(page: sync_api.Page) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(page.evaluate(IMAGE)), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def within(image: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the image is the picture with bars around it."""
    found = cv2.matchTemplate(image, picture, cv2.TM_SQDIFF)
    top, left = np.unravel_index(found.argmin(), found.shape)
    height, width = picture.shape[:2]
    return np.array_equal(image[top : top + height, left : left + width], picture)


def test_a_browser_shows_render_views_bytes_and_saves_what_render_repeats(browser, tmp_path):
    edits = Edits("dense-fog", SCALE, folder=tmp_path / "views")
    with served(edits) as (viewer, url):
        page = opened(browser, url)
        camera = viewer.scene.frames[0].cameras["front"]
        assert within(image_of(page), render_view(viewer.scene, camera, edits.recipe()).rgb)
        number = page.get_by_role("textbox", name="visibility_m", exact=True)
        number.fill("30")
        number.press("Enter")
        page.get_by_text("more of smog").click()
        page.get_by_role("slider").nth(1).press("ArrowRight")  # overcast
        at_rest(page)
        page.get_by_role("tab", name="Save").click()
        page.get_by_role("button", name="Save picture").click()
        page.get_by_text("Saved my-weather").wait_for()
        command = page.locator("textarea").input_value()
        saved = cv2.imread(str(tmp_path / "views" / "my-weather.png"))[..., ::-1]
        assert within(image_of(page), saved)
        page.close()
    text = (tmp_path / "views" / "my-weather.yaml").read_text()
    assert "visibility_m: 30" in text
    assert np.array_equal(rendered(tmp_path / "out", command), saved)


def test_arrow_keys_move_the_slider_that_has_the_focus_and_else_the_camera(browser, tmp_path):
    with served(Edits("dense-fog", SCALE, folder=tmp_path)) as (viewer, url):
        page = opened(browser, url)
        (own,) = viewer.pages
        number = page.get_by_role("textbox", name="visibility_m", exact=True)
        before = float(number.input_value())
        # The slider is logarithmic; no box tells its place beside the value's.
        boxes = [box.input_value() for box in page.locator("input:visible").all()]
        assert boxes.count("on") == len(boxes) - 2  # ticks, the preset and the visibility
        slider = page.get_by_role("slider").first
        for _ in range(5):
            slider.press("ArrowRight", delay=200)
        at_rest(page)
        assert before * 1.05 < float(number.input_value()) < before * 1.2
        smog = own.recipe(own.request.edits).weather.smog
        assert smog is not None and smog.visibility_m == float(number.input_value())
        page.get_by_role("tab", name="Weather").press("ArrowRight", delay=500)
        page.wait_for_timeout(2000)
        assert own.request.pose is None  # neither has flown
        page.mouse.click(300, 250)
        page.keyboard.down("ArrowRight")
        page.wait_for_function("() => document.body.innerText.includes('not of this view yet')")
        page.keyboard.up("ArrowRight")
        at_rest(page)
        assert own.request.pose is not None
        page.close()


def test_a_new_preset_is_not_at_rest_before_its_own_picture_is_there(browser, tmp_path):
    with served(Edits("clear", SCALE, folder=tmp_path)) as (viewer, url):
        page = opened(browser, url)
        page.get_by_label("preset").first.click()
        page.get_by_role("option", name="fresh-snow", exact=True).click()
        page.wait_for_function(
            "() => document.body.innerText.includes('finding exposed surfaces, step')"
        )
        assert "at rest" not in page.locator("body").inner_text()
        at_rest(page)
        camera = viewer.scene.frames[0].cameras["front"]
        recipe = Edits("fresh-snow", SCALE).recipe()
        assert within(image_of(page), render_view(viewer.scene, camera, recipe).rgb)
        page.close()


def test_two_tabs_fly_apart_and_a_killed_one_leaves_the_other(browser, tmp_path):
    with served(Edits("clear", SCALE, folder=tmp_path)) as (viewer, url):
        one, two = opened(browser, url), opened(browser, url)
        before = image_of(two)
        one.mouse.move(300, 250)
        one.mouse.down()
        for step in range(10):
            one.mouse.move(300 + 8 * step, 250)
        one.mouse.up()
        at_rest(one)
        flown = image_of(one)
        assert flown.shape != before.shape or np.abs(flown.astype(int) - before).mean() > 3
        assert np.array_equal(image_of(two), before)
        one.close()
        for _ in range(600):
            if len(viewer.pages) == 1:
                break
            time.sleep(0.1)
        assert len(viewer.pages) == 1
        two.get_by_role("tab", name="View").click()
        two.get_by_role("slider").first.press("ArrowRight")  # the frame's
        at_rest(two)
        assert not np.array_equal(image_of(two), before)
        two.close()


# How a page's attempt to connect ends.
CONNECT = """address => new Promise(done => {
  const socket = new WebSocket(address, ["viser-v1.1.0"]);
  socket.onopen = () => done("open");
  socket.onerror = () => done("refused");
})"""


def test_pages_of_other_sites_connect_to_nothing_while_the_page_is_open(browser, tmp_path):
    output = OutputViewer(open_store(str(hostile_output(tmp_path / "out"))))
    with serve(import_viser(), output, "127.0.0.1", 0) as url:
        host = urlsplit(url).netloc
        port = host.rpartition(":")[2]
        context = browser.new_context()
        page = context.new_page()
        page.goto(url)
        page.get_by_text("2 images").wait_for(timeout=WAIT_MS)
        assert page.evaluate(CONNECT, f"ws://{host}") == "open"  # by its cookie
        context.route("http://*/elsewhere", lambda route: route.fulfill(body="<p>elsewhere</p>"))
        local = tmp_path / "page.html"
        local.write_text("<p>a file</p>")
        sites = ["http://evil.example/elsewhere", "http://localhost:45999/elsewhere",
                 "http://127.0.0.1:45999/elsewhere", local.as_uri(), "about:blank"]  # fmt: skip
        for site in sites:
            other = context.new_page()
            other.goto(site)
            for address in (host, f"127.0.0.1:{port}", f"[::1]:{port}"):
                assert other.evaluate(CONNECT, f"ws://{address}") == "refused", site
            other.close()
        # A page whose address names another server, or that is in a frame, is not sent.
        other = context.new_page()
        answer = other.goto(f"http://{host}/?websocket=ws://evil.example")
        assert answer is not None and answer.status == 403
        other.goto(sites[1])
        other.set_content(f'<iframe src="{url}"></iframe>')
        other.wait_for_timeout(1500)
        assert not any(frame.url.startswith("http") and "2 images" in frame.content()
                       for frame in other.frames)  # fmt: skip
        context.close()


def test_texts_of_a_manifest_run_nothing_in_a_browser(browser, tmp_path):
    output = OutputViewer(open_store(str(hostile_output(tmp_path / "out"))))
    with serve(import_viser(), output, "127.0.0.1", 0) as url:
        page = browser.new_page()
        requests = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto(url)
        page.get_by_text("onerror=globalThis.PWNED=1").first.wait_for(timeout=WAIT_MS)
        page.get_by_label("variant").first.click()
        page.get_by_role("option").last.click()
        page.get_by_role("slider").first.press("ArrowRight")
        page.wait_for_timeout(1000)
        text = page.inner_text("body")
        assert page.evaluate("globalThis.PWNED") is None and "Error Parsing" not in text
        # Nor does anything go to another server; and nothing offers to share the page.
        own = ("data:", "blob:", url.partition("?")[0])
        assert not [address for address in requests if not address.startswith(own)]
        assert page.locator(".tabler-icon-share").count() == 0
        page.close()


def test_the_command_serves_until_it_is_interrupted(browser, tmp_path):
    command = [sys.executable, "-m", "tools.cli", "view", SMALL_STREET, "--scale", str(SCALE)]
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen(
        [*command, "--port", "0", "--no-cache", "--out", str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=root,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        said = []
        for line in process.stdout:
            said.append(line)
            if "Ctrl-C" in line:
                break
        url = said[-1].split()[1]
        page = opened(browser, url)
        assert image_of(page).shape[0] > 50
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        rest = process.stdout.read()
        assert "Traceback" not in rest, rest
        page.close()
    assert SMALL_STREET in said[-1]
