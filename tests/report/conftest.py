"""Results that are shown, and the browser that shows them."""

import os
import shutil

import numpy as np
import pytest
from independent import REFERENCE, REFERENCE_TIME, random_steps, simulate

import jaxgray

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="session")
def identification():
    """The reference system, identified from a short record and held against another."""
    records = []
    for seed in (21, 22):
        rng = np.random.default_rng(seed)
        u = random_steps(rng, 1500, 2, REFERENCE_TIME, hold_times=(0.2, 1.0))
        y = simulate(*REFERENCE.values(), u, REFERENCE_TIME)
        units = {"input_units": ("N", "N"), "output_units": ("m", "m")}
        records.append(jaxgray.Record(u, y + 3e-4 * rng.standard_normal(y.shape), REFERENCE_TIME, **units))
    return jaxgray.identify(records[0], validation=records[1], time_constants=[0.05, 0.1], block_rows=[4, 6])


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium; what needs it is skipped where there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install '.[test]')")
    found = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if found is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    arguments = ["--no-sandbox"] if os.getuid() == 0 else []
    with api.sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=found, args=arguments)
        yield made
        made.close()


class Opened:
    """A page in the browser: `page`, and what it said on the console."""

    def __init__(self, browser, path, *, width=1280, height=800, dark=False):
        scheme = "dark" if dark else "light"
        self.context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        self.page = self.context.new_page()
        self.said, self.asked = [], []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_function("document.documentElement.dataset.ready === 'yes'", timeout=30_000)

    def __getattr__(self, name):
        return getattr(self.page, name)


@pytest.fixture
def opened(browser):
    """Open a file; every page is closed after the test."""
    contexts = []

    def show(path, **options):
        made = Opened(browser, path, **options)
        contexts.append(made.context)
        return made

    yield show
    for context in contexts:
        context.close()
