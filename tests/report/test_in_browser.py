"""The page in a true browser: no request, no overflow on a phone, printable."""

import os
from pathlib import Path

import pytest
from finished_session import evaluation, finished, photograph

from handeye_tri.report import Origin, render_report

CHROMIUM = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    done = finished()
    html = render_report(
        evaluation(done),
        *(done.session, done.cameras, done.calibration, done.track),
        # Names that have nowhere to break are the hard case on a phone.
        origin=Origin(
            cell="a_cell_with_a_rather_long_name_that_has_no_space",
            seed=1,
            command="handeye-tri run " + "x" * 200,
            software={f"package-{k}": "1.2.3" for k in range(12)},
            files={"observations.npz": "0123456789abcdef" * 4},
            certificate={"sigma.left.fx_px": 0.4},
        ),
        photograph=photograph,
    )
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(html, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM.is_file():
        pytest.skip(f"no browser at {CHROMIUM}")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=str(CHROMIUM), args=["--no-sandbox", "--disable-gpu"]
        )
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser, page_file):
    def show(width):
        page = browser.new_page(viewport={"width": width, "height": 844})
        page.requests, page.errors = [], []
        page.on("request", lambda request: page.requests.append(request.url))
        page.on("console", lambda message: page.errors.append(message.text))
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto(page_file.as_uri())
        return page

    return show


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_nothing_overflows_and_nothing_is_requested(opened, page_file, width):
    page = opened(width)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.requests == [page_file.as_uri()]
    assert page.errors == []
    # Figures fill their place and no more.
    for figure in page.query_selector_all("figure svg"):
        box = figure.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
    page.close()


def test_the_verdict_is_on_the_first_screen_of_a_phone(opened):
    page = opened(390)
    box = page.query_selector("header.verdict").bounding_box()
    assert box["y"] + box["height"] < 844
    assert page.query_selector("h1").inner_text() == "PASS"
    page.close()


def test_writing_in_figures_can_be_read_on_a_phone(opened):
    """At least 6 px high; the body's own text is 15 px."""
    page = opened(390)
    sizes = page.evaluate(
        "[...document.querySelectorAll('figure svg text')].map("
        "t => parseFloat(getComputedStyle(t).fontSize) * t.getCTM().a)"
    )
    assert len(sizes) > 30
    assert min(size for size in sizes if size > 0) > 6.0
    page.close()


def test_one_click_selects_a_matrix(opened):
    page = opened(1280)
    block = page.query_selector("pre")
    block.click()
    selected = page.evaluate("window.getSelection().toString()").strip()
    assert selected == block.inner_text().strip()
    assert selected.startswith("[[")
    page.close()


def test_links_lead_to_their_sections(opened):
    page = opened(1280)
    for link in page.query_selector_all("nav a"):
        target = link.get_attribute("href")
        assert page.query_selector(f"section{target}") is not None
    page.close()


def test_print_shows_every_row(opened):
    page = opened(1280)
    page.emulate_media(media="print")
    clipped = page.evaluate(
        "[...document.querySelectorAll('.tall')]"
        ".filter(e => e.scrollHeight > e.clientHeight + 1).length"
    )
    assert clipped == 0
    assert page.pdf(format="A4").startswith(b"%PDF")
    page.close()
