"""A real browser that does on the page what a person does: draws, drags, steers, types."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.actions.interaction import POINTER_MOUSE, POINTER_TOUCH
from selenium.webdriver.common.actions.pointer_input import PointerInput
from selenium.webdriver.common.keys import Keys

OPTIONS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"]
OPTIONS += ["--disable-background-networking", "--disable-component-update", "--hide-scrollbars"]
PATIENCE = 120.0
"""Seconds that anything may take before a test fails."""
TOLD = "(document.getElementById('error-text') || document.body).textContent"
"""What is said on a page if it is one of the program's."""
Point = tuple[float, float]


def installed() -> bool:
    """Whether there is a browser, and the program that drives it."""
    return bool(_program() and shutil.which("chromedriver"))


def _program() -> str | None:
    return next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)


@contextmanager
def browser(folder: Path, width: int = 1280, height: int = 900, dark: bool = False) -> Iterator["Browser"]:
    """A browser whose profile and downloads are in a folder."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(_program())
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    downloads = folder / "downloads"
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    for option in (*OPTIONS, f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}"):
        options.add_argument(option)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.set_script_timeout(PATIENCE)
        found = Browser(driver, downloads)
        found.window(width, height, dark)
        yield found
    finally:
        driver.quit()


class Browser:
    """What a person does, and sees.

    Attributes:
        downloads: folder of what a page gives to be saved.
        pause: seconds between two looks at what is waited for.
    """

    def __init__(self, driver: webdriver.Chrome, downloads: Path) -> None:
        self.driver, self.downloads, self.pause = driver, downloads, 0.02

    def window(self, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        """Be a screen of another size, or a phone."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def open(self, address: str) -> None:
        """Open a page of the program, and wait until it has drawn its first state."""
        self.errors()  # of the page before
        self.driver.get(address)
        self.until(lambda: self.data("ready"))

    def js(self, script: str, *arguments: Any) -> Any:
        """What a script returns."""
        return self.driver.execute_script(f"return {script}", *arguments)

    def data(self, name: str) -> str:
        """A word that the page says of itself, for those who wait."""
        return self.js(f"document.body.dataset.{name} || ''")

    def until(self, what: Callable[[], Any], seconds: float = PATIENCE) -> None:
        """Wait until something is so.

        Raises:
            AssertionError: if it takes too long, with what the page says.
        """
        begin = time.monotonic()
        while not what():
            if time.monotonic() - begin > seconds:
                raise AssertionError(f"waited {seconds} s; the page says {self.js(TOLD)!r}")
            time.sleep(self.pause)

    def sampled(self, before: int = 0) -> None:
        """Wait until there are samples, after so many sets of them."""
        self.until(lambda: int(self.data("samples") or 0) > before)

    def text(self, name: str) -> str:
        """Of an element by its id."""
        return self.js("document.getElementById(arguments[0]).textContent.trim()", name)

    def count(self, selector: str) -> int:
        """Elements that a person can see."""
        script = "[...document.querySelectorAll(arguments[0])].filter((one) => one.getClientRects().length > 0).length"
        return int(self.js(script, selector))

    def click(self, name: str) -> None:
        """An element by its id."""
        self.js("document.getElementById(arguments[0]).scrollIntoView({block: 'center'})", name)
        self.driver.find_element("id", name).click()

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element in the window, in pixels, after it came in sight."""
        script = (
            "((one) => { one.scrollIntoView({block: 'center'}); const box = one.getBoundingClientRect();"
            " return [box.left, box.top, box.width, box.height]; })(document.querySelector(arguments[0]))"
        )
        return tuple(self.js(script, selector))

    def drag(self, points: Sequence[Point], touch: bool = False, milliseconds: int = 8) -> None:
        """Press at the first of some places in the window, go through all, and let go."""
        pointer = PointerInput(POINTER_TOUCH if touch else POINTER_MOUSE, "finger" if touch else "mouse")
        actions = ActionBuilder(self.driver, mouse=pointer, duration=milliseconds)
        for number, (x, y) in enumerate(points):
            actions.pointer_action.move_to_location(round(x), round(y))
            if number == 0:
                actions.pointer_action.pointer_down()
        actions.pointer_action.pointer_up()
        actions.perform()

    def places(self, path: Sequence[Point], selector: str = "#show") -> list[Point]:
        """Where points of the canvas's own unit are in the window."""
        left, top, width, height = self.box(selector)
        x0, y0, wide, high = self.js("recorder.scene.film.window")
        return [(left + (x - x0) / wide * width, top + (1 - (y - y0) / high) * height) for x, y in path]

    def draw(self, path: Sequence[Point], touch: bool = False) -> None:
        """A line on the canvas, in its own unit."""
        self.drag(self.places(path), touch)

    def press(self, *keys: str) -> None:
        """Keys, wherever the focus is."""
        for key in keys:
            ActionChains(self.driver).send_keys(key).perform()

    def undo(self) -> None:
        """The keys that undo something."""
        ActionChains(self.driver).key_down(Keys.CONTROL).send_keys("z").key_up(Keys.CONTROL).perform()

    def read_aloud(self) -> list[dict[str, str]]:
        """Role and name of all that a screen reader reads, in its order."""
        self.driver.execute_cdp_cmd("Accessibility.enable", {})
        nodes = self.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        by_id, found = {node["nodeId"]: node for node in nodes}, []

        def visit(node: dict[str, Any]) -> None:
            if not node.get("ignored"):
                found.append({key: str(node.get(key, {}).get("value", "")) for key in ("role", "name")})
            for child in node.get("childIds", []):
                if child in by_id:
                    visit(by_id[child])

        visit(nodes[0])
        return found

    def errors(self) -> list[str]:
        """What the browser complains of."""
        return [str(one["message"]) for one in self.driver.get_log("browser") if one["level"] == "SEVERE"]

    def picture(self, path: Path) -> None:
        """The window as it is."""
        self.driver.save_screenshot(str(path))
