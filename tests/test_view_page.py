"""The page of the live view, served by viser and opened in headless Chromium.

Set VSR_JAX_SCREENSHOTS to a folder to look at what the browser shows.
"""

import importlib.util
import io
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

import vsr_jax as vsr
from vsr_jax.files.scene_file import parse_scene

pytest.importorskip("viser", reason='needs pip install "vsr-jax[viewer]"')

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or importlib.util.find_spec("playwright") is None,
    reason="needs the browser chromium and pip install playwright",
)
MODEL = vsr.StrainDependent(6)
LENGTH, ANGLES = 0.3, 24
INPUTS = [3.0, 0.5, 1.5]
FORCE = "loads[0].force[2]"
PILLAR = str(pathlib.Path(__file__).parents[1] / "notebooks" / "scenes" / "pillar.toml")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def scene():
    """Three tendons and a tip force."""
    rod = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(young=5.93e5, shear=2.00e5))
    angles = 2 * np.pi / 3 * np.arange(3)
    paths = [vsr.Parallel(0.007 * np.cos(a), 0.007 * np.sin(a)) for a in angles]
    tip_force = vsr.TipWrench(force=(0.0, 0.0, -0.05))
    return vsr.Scene(rod, [vsr.Tendon(path) for path in paths], [tip_force])


@pytest.fixture
def page(scene):
    """The page, with the arm on it."""
    with vsr.view(
        scene,
        INPUTS,
        numbers={FORCE: (-0.1, 0.1)},
        bounds=((0.0, 0.0, 0.0), (4000.0, 8.0, 8.0)),
        model=MODEL,
        title="three tendons",
        port=free_port(),
        browser=False,
        block=False,
    ) as page:
        page.move({}).wait()
        yield page


def free_port():
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


def expected(page):
    """The equilibrium of what the page is set to, by `vsr.solve` from nothing."""
    inputs, numbers = page.session.answer.setting
    return vsr.solve(page.session.scene.replace(numbers), inputs, model=MODEL)


def node(page, name):
    """An object of the scene that viser sends to browsers."""
    return page.server.scene.get_handle_by_name(name)


def drawn_axis(page):
    """Middles of the rings of the wall as it is sent to browsers [m]."""
    names = ["/arm/wall/plain", *(f"/arm/wall/{i}" for i in range(32))]
    handles = [node(page, name) for name in names]
    sent = [h.vertices for h in handles if h is not None and h.visible]
    corners = np.unique(np.concatenate(sent), axis=0)
    eq = expected(page)
    X = np.linspace(0, float(eq.scene.rod.length), 61)
    rings = np.asarray(eq.summary(X).wall)[:, :-1].astype(np.float32)
    every = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    off = np.linalg.norm(corners[:, None] - every[None], axis=-1)
    assert np.max(off.min(axis=1)) < 1e-6  # nothing else is drawn
    assert np.max(off.min(axis=0)) < 1e-6  # and everything is
    return corners


@pytest.mark.slow
def test_what_is_sent_to_browsers_is_what_solve_finds(page):
    before = drawn_axis(page)
    page.move({"inputs[0]": 4.0, FORCE: 0.03}).wait()
    after = drawn_axis(page)
    assert np.max(np.abs(after[-1] - before[-1])) > 0.01
    eq = expected(page)
    arrow = node(page, "/loads").points
    np.testing.assert_allclose(arrow[0, 0], eq.tip[:3, 3], atol=1e-6)
    np.testing.assert_allclose(arrow[0, 1] - arrow[0, 0], [0, 0, 0.6 * 0.16 * LENGTH], atol=1e-6)
    np.testing.assert_allclose(node(page, "/tip").position, eq.tip[:3, 3], atol=1e-6)
    segments = node(page, "/arm/threads").points.reshape(3, 60, 2, 3)
    X = np.linspace(0, LENGTH, 61)
    np.testing.assert_allclose(segments[1, :, 1], eq.thread(1, X[1:]), atol=1e-6)
    page.move({"inputs[0]": 0.0}).wait()
    assert len(node(page, "/arm/threads").points) == 150  # one of three is dashed


@pytest.mark.slow
def test_a_collapsed_arm_is_dimmed_and_two_views_have_two_ports(page, scene):
    page.move({"inputs[0]": 4000.0}).wait()
    assert page.session.answer.failure == expected(page).message
    assert node(page, "/arm/wall/plain").opacity == 0.15
    assert node(page, "/arm/wall/plain").visible
    assert not node(page, "/loads").visible
    port = int(page.url.rsplit(":", 1)[1])
    with vsr.view(scene, INPUTS, model=MODEL, port=port, browser=False, block=False) as other:
        assert other.url != page.url


@pytest.mark.slow
def test_obstacles_follow_their_numbers(scene):
    ball = vsr.Sphere((0.15, 0.1, 0.1), 0.03)
    among = vsr.Scene(
        scene.rod, scene.actuators, obstacles=[vsr.Plane((0, 0, 1), (0, 0, -0.1)), ball]
    )
    name = "obstacles[1].radius"
    options = {"model": MODEL, "port": free_port(), "browser": False, "block": False}
    with vsr.view(among, INPUTS, numbers=[name], **options) as page:
        page.move({}).wait()
        np.testing.assert_allclose(node(page, "/obstacles/0").vertices[:, 2], -0.1, atol=1e-6)
        page.move({name: 0.04}).wait()
        away = np.linalg.norm(node(page, "/obstacles/1").vertices - ball.centre, axis=1)
        np.testing.assert_allclose(away, 0.04, atol=1e-6)


def test_ctrl_c_ends_the_command_at_once_while_it_compiles():
    """XLA aborts if the interpreter ends below a thread that compiles."""
    code = "import sys; from vsr_jax.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "view", PILLAR, "--no-browser"]
    command += ["--no-cache", "--port", str(free_port())]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "Ctrl-C" in process.stderr.readline()
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
    assert (process.returncode, said) == (0, "")
    assert time.monotonic() - start < 3


class Browser:
    """A page in Chromium."""

    def __init__(self, page, tab):
        self.page, self.tab = page, tab
        folder = os.environ.get("VSR_JAX_SCREENSHOTS")
        self.folder = None if folder is None else pathlib.Path(folder)

    def shot(self, name):
        if self.folder is not None:
            time.sleep(5.0)  # for the software renderer
            self.tab.screenshot(path=self.folder / f"{name}.png")

    def says(self, text):
        self.tab.get_by_text(text).first.wait_for(timeout=60_000)

    def tip_said(self):
        """The tip in the page [m]."""
        text = self.tab.get_by_text(re.compile(r"^tip \(")).inner_text()
        return 1e-3 * np.array([float(x) for x in re.findall(r"-?[\d.]+", text)])

    def waits_for(self, condition, seconds=60):
        deadline = time.time() + seconds
        while not condition():
            assert time.time() < deadline
            time.sleep(0.05)

    def slider(self, label):
        """The thumb of a slider, and the box with its number."""
        row = self.tab.locator("label").filter(has_text=label).locator("xpath=../../..")
        return row.get_by_role("slider").first, row.get_by_role("textbox").first

    def pixel(self, point):
        """Where a point [m] is on the screen."""
        (client,) = self.page.server.get_clients().values()
        camera = client.camera
        w, x, y, z = camera.wxyz
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        seen = turn.T @ (np.asarray(point) - camera.position)
        scale = camera.image_height / 2 / np.tan(camera.fov / 2)
        middle = np.array([camera.image_width, camera.image_height]) / 2
        return middle + scale * seen[:2] / seen[2]


@pytest.fixture
def browser(page):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        tab = chromium.new_page(viewport={"width": 1200, "height": 860}, accept_downloads=True)
        tab.goto(page.url)
        made = Browser(page, tab)
        made.says("converged")
        made.waits_for(lambda: page.server.get_clients())
        yield made
        chromium.close()


@needs_browser
@pytest.mark.slow
def test_the_page_in_a_browser(page, browser, tmp_path):
    _slides(page, browser)
    _drags(page, browser)
    _saves(page, browser)
    _plays(page, browser)
    _collapses(page, browser)


def _slides(page, browser):
    tab = browser.tab
    np.testing.assert_allclose(browser.tip_said(), expected(page).tip[:3, 3], atol=1e-4)
    browser.shot("strain")
    thumb, box = browser.slider(f"{FORCE} [mN]")
    place = thumb.bounding_box()
    middle = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    tab.mouse.move(*middle)
    tab.mouse.down()
    tab.mouse.move(middle[0] + 40, middle[1], steps=20)
    tab.mouse.up()
    browser.waits_for(
        lambda: page.session.answer.setting.numbers.get("loads[0].force", [0, 0, -1])[2] > 0.0
    )
    box.fill("-20")
    browser.waits_for(lambda: page.session.answer.setting.numbers["loads[0].force"][2] == -0.02)
    _, box = browser.slider("inputs[1] [N]")
    box.fill("0.8")
    browser.waits_for(lambda: page.session.answer.setting.inputs[1] == 0.8)
    browser.waits_for(lambda: np.allclose(browser.tip_said(), expected(page).tip[:3, 3], atol=1e-4))
    drawn_axis(page)
    for choice, label in (("stress", "von Mises stress"), ("tension", "thread tension")):
        tab.get_by_label("colour").click()
        tab.get_by_role("option", name=choice).click()
        browser.says(label)
        browser.shot(choice)
    assert node(page, "/arm/wall/plain").visible
    tab.get_by_label("dark", exact=True).check()
    browser.shot("dark")
    tab.get_by_label("dark", exact=True).uncheck()


def _drags(page, browser):
    """The blue arrow of the handle, upward."""
    tip, before = page.session.answer.shape.tip, page.session.answer.setting.inputs
    arm = np.array([0.0, 0.0, 0.13 * LENGTH])
    start, end = browser.pixel(tip + 0.7 * arm), browser.pixel(tip + 1.0 * arm)
    mouse = browser.tab.mouse
    mouse.move(*start)
    time.sleep(2.0)  # the software renderer has to see the mouse over the handle
    mouse.down()
    for share in np.linspace(0.1, 1, 10):
        mouse.move(*(start + share * (end - start)))
        time.sleep(0.1)
    browser.says("compiling the drag of the tip")
    browser.waits_for(lambda: page.session.answer.shape.tip[2] > tip[2] + 0.005, seconds=300)
    browser.shot("dragged")
    mouse.up()
    page.move({}).wait()
    now = page.session.answer
    np.testing.assert_allclose(now.shape.tip, expected(page).tip[:3, 3], atol=1e-8)
    np.testing.assert_allclose(now.shape.tip[:2], tip[:2], atol=3e-4)
    assert np.max(np.abs(now.setting.inputs - before)) > 1e-3
    browser.waits_for(lambda: np.allclose(node(page, "/tip").position, now.shape.tip, atol=1e-6))


def _saves(page, browser):
    with browser.tab.expect_download() as waiting:
        browser.tab.get_by_role("button", name="Scene (TOML)").click()
    saved = parse_scene(pathlib.Path(waiting.value.path()).read_text())
    np.testing.assert_allclose(saved.inputs, page.session.answer.setting.inputs, rtol=1e-12)
    np.testing.assert_allclose(saved.scene.loads[0].force, [0, 0, -0.02], atol=1e-12)
    with browser.tab.expect_download() as waiting:
        browser.tab.get_by_role("button", name="Picture (PNG)").click()
    picture = Image.open(io.BytesIO(pathlib.Path(waiting.value.path()).read_bytes()))
    pixels = np.asarray(picture.convert("RGB"), float)
    assert np.mean(np.all(pixels > 250, axis=-1)) > 0.5  # paper
    red, _, blue = np.moveaxis(pixels, -1, 0)
    assert np.sum(red - blue > 50) > 500  # tendons that pull, seen through the wall; the x axis
    assert np.sum(blue - red > 50) > 500  # the z axis
    if browser.folder is not None:
        picture.save(browser.folder / "picture.png")


def _plays(page, browser):
    browser.tab.get_by_role("button", name="Play").click()
    browser.waits_for(lambda: page.session.answer.setting.inputs[0] == 4000.0)
    browser.says("no equilibrium")  # long before the greatest tension
    browser.tab.get_by_role("button", name="Reset").click()
    browser.says("converged")
    np.testing.assert_array_equal(page.session.answer.setting.inputs, INPUTS)


def _collapses(page, browser):
    tip = page.session.answer.shape.tip
    _, box = browser.slider("inputs[0] [kN]")
    box.fill("4")
    browser.says("no equilibrium")
    browser.says("dimmed: the last shape")
    browser.says(page.session.answer.failure)
    np.testing.assert_array_equal(page.session.answer.shape.tip, tip)
    assert node(page, "/arm/wall/plain").opacity == 0.15
    browser.shot("collapsed")
