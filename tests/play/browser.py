"""A real browser that does on the page what a person does: draws, drags, steers, types."""

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

OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)
CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
Point = tuple[float, float]


@contextmanager
def browser(folder: Path, width: int = 1280, height: int = 900, dark: bool = False) -> Iterator["Browser"]:
    """A browser with a profile of its own in a folder."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for option in (*OPTIONS, f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}"):
        options.add_argument(option)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(DRIVER)))
    try:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        yield Browser(driver)
    finally:
        driver.quit()


class Browser:
    """What a person does, and sees."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def open(self, address: str) -> float:
        """Open a page; returns the seconds until it has drawn its first state."""
        begin = time.monotonic()
        self.driver.get(address)
        self.until(lambda: self.data("ready"))
        return time.monotonic() - begin

    def js(self, script: str, *arguments: Any) -> Any:
        """What a script returns."""
        return self.driver.execute_script(f"return {script}", *arguments)

    def data(self, name: str) -> str:
        """A word that the page says of itself, for those who wait."""
        return self.js(f"document.body.dataset.{name} || ''")

    def until(self, what: Callable[[], Any], seconds: float = 60.0) -> float:
        """Wait until something is so; returns how long it took.

        Raises:
            AssertionError: if it takes too long, with what the page says.
        """
        begin = time.monotonic()
        while not what():
            told = self.text("error-text") if self.js("Boolean(document.getElementById('error-text'))") else ""
            assert time.monotonic() - begin < seconds, f"waited {seconds} s; the page says {told!r}"
            time.sleep(0.02)
        return time.monotonic() - begin

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
        left, top, width, height = self.js(script, selector)
        return left, top, width, height

    def drag(self, points: Sequence[Point], touch: bool = False, milliseconds: int = 8) -> None:
        """Press at the first of some places in the window, go through all, and let go."""
        pointer = PointerInput(POINTER_TOUCH if touch else POINTER_MOUSE, "finger" if touch else "mouse")
        actions = ActionBuilder(self.driver, mouse=pointer, duration=milliseconds)
        first, *rest = points
        actions.pointer_action.move_to_location(round(first[0]), round(first[1])).pointer_down()
        for x, y in rest:
            actions.pointer_action.move_to_location(round(x), round(y))
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

    def errors(self) -> list[str]:
        """What the browser complains of."""
        return [str(one["message"]) for one in self.driver.get_log("browser") if one["level"] == "SEVERE"]

    def picture(self, path: Path) -> None:
        """The window as it is."""
        self.driver.save_screenshot(str(path))
