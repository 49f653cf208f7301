"""The report's page: order, words, digits, escaping; no need of a browser."""

import re
from dataclasses import asdict, replace
from html.parser import HTMLParser

import numpy as np
import pytest
from finished_session import (
    evaluation,
    finished,
    finished_on_two_mounts,
    photograph,
)

from handeye_tri.diagnose import Finding
from handeye_tri.report import Origin, figures, geometry, render_report
from handeye_tri.report.tables import (
    gates_worst_first,
    half_turn_words,
    number,
    quantities,
    station_mounts,
)

ORIGIN = Origin(
    cell="hp3_stereo",
    seed=1,
    command="handeye-tri run hp3_stereo -o out --seed 1",
    software={"handeye-tri": "0.1.0", "numpy": "2.4"},
    files={"plan.json": "ab" * 32},
    certificate={"sigma.left.fx_px": 0.41, "track_calibration_rms_mm": 0.03},
)


def page(done=None, changes=None, **options):
    done = done or finished()
    return render_report(
        {**evaluation(done), **(changes or {})},
        *(done.session, done.cameras, done.calibration, done.track),
        **{"origin": ORIGIN, **options},
    )


@pytest.fixture(scope="module")
def html():
    return page(photograph=photograph)


class Reader(HTMLParser):
    """Text, headings and whether every tag is closed in order."""

    VOID = {"meta", "link", "br", "path", "use", "image"}

    def __init__(self):
        super().__init__()
        self.open, self.headings, self.text, self.ids = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "h2":
            self.headings.append("")

    def handle_startendtag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "h2" in self.open:
            self.headings[-1] += data
        if not {"style", "svg"} & set(self.open):
            self.text.append(data)


def read(html):
    reader = Reader()
    reader.feed(html)
    assert reader.open == []
    return reader


def text_of(html):
    return re.sub(r"\s+", " ", " ".join(read(html).text))


def strip_of(html):
    return text_of(html[html.index("<header") : html.index("</header>") + 9])


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the drawing, which takes most of the time."""
    for module in (figures, geometry):
        monkeypatch.setattr(module, "svg", lambda name, draw, height: "<svg></svg>")


def test_sections_are_in_order_verdict_first(html):
    headings = read(html).headings
    assert [heading.lstrip("0123456789") for heading in headings] == [
        "The numbers to use",
        "How far off where you work",
        "Where the error comes from",
        "Gates and findings",
        "Were the motions enough?",
        "Every view, worst first",
        "Cameras",
        "Cross-checks",
        "Assumed, not checked",
        "How to get this again",
    ]
    numbers = [int(re.match(r"\d+", heading)[0]) for heading in headings]
    assert numbers == list(range(2, 12))
    assert html.index("<h1>PASS</h1>") < html.index("<h2>")
    assert "Consistent with the prediction: 95 % of such tests" in html


def test_identities_are_unique_across_figures(html):
    ids = read(html).ids
    clash = {name for name in ids if ids.count(name) > 1}
    # matplotlib numbers its groups in every figure; nothing refers to those.
    assert not [name for name in clash if f"#{name}" in html]


def test_the_strip_says_simulated_or_real_and_the_figures(html, undrawn):
    strip = strip_of(html)
    track = finished().track
    assert "SIMULATED" in strip
    assert f"{1e3 * track.mean:.3f} mm mean" in strip
    assert f"{1e3 * track.max:.3f} mm worst" in strip
    real = page(changes={"simulated": False})
    assert "REAL" in strip_of(real)


@pytest.mark.parametrize("outcome", ["FAIL", "CANNOT TELL"])
def test_without_a_pass_the_failure_leads_and_numbers_are_warned_of(outcome, undrawn):
    finding = Finding(
        *("LOOP", "robot and cameras disagree", "4.2 (limit 1.6)"),
        *("error", "check the pairing"),
    )
    html = page(changes={"verdict": outcome, "findings": [asdict(finding)]})
    text = text_of(html)
    assert f"The verdict is {outcome}: do not use these numbers." in text
    assert text.index("Do: check the pairing.") < text.index("The numbers to use")
    assert f'class="verdict {outcome.split()[0]}"' in html


def test_findings_say_where_and_what_follows_from_them_comes_last(undrawn):
    findings = [
        Finding("SLIP", "c", "e", "warning", "r", (4, 6)),
        Finding("LOOP", "l", "4.2", "error", "mend", follows="SLIP"),
        Finding("POOR", "p", "e", "warning", "r", camera="left"),
    ]
    text = text_of(page(changes={"findings": [asdict(one) for one in findings]}))
    assert "SLIP c (stations 4, 6)" in text
    assert "POOR p (camera left)" in text
    assert text.index("POOR p") < text.index("Likely follows from SLIP: LOOP l; 4.2.")
    assert "Do: mend" not in text
    assert "SLIP, POOR; what follows from them: LOOP" in text


def test_every_estimated_quantity_is_there_with_its_sigma(html):
    text = text_of(html)
    for row in evaluation(finished())["result"]:
        assert number(row["value"], row["sigma"]) in text, row["name"]
        assert number(row["sigma"], row["sigma"]) in text, row["name"]


def test_truth_has_a_column_only_where_it_is_known(undrawn):
    assert "truth − value" in text_of(page())
    rows = [{**row, "error": None} for row in evaluation(finished())["result"]]
    assert "truth − value" not in text_of(page(changes={"result": rows}))


def test_matrices_to_copy_are_the_result(html):
    blocks = re.findall(r"<pre>(\[\[.*?)</pre>", html, re.DOTALL)
    calibration = finished().calibration
    motions = [*calibration.base_from_camera, calibration.flange_from_triangle]
    for block, motion in zip(blocks, motions, strict=True):
        rows = [float(x) for x in re.findall(r"-?\d+\.\d+", block)]
        assert np.allclose(np.reshape(rows, (4, 4)), motion.matrix, atol=5e-10)


def test_every_view_has_a_row_and_the_worst_leads(html):
    section = html[html.index('id="views"') : html.index('id="cameras"')]
    sigmas = [
        float(x)
        for x in re.findall(
            r'<td class="n">(\d+\.\d)</td><td(?: class="bad")?>', section
        )
    ]
    session = finished().session
    assert len(sigmas) == len(session.cameras) * len(session.stations)
    assert sigmas == sorted(sigmas, reverse=True)
    assert section.count("<image") == 6


def test_names_and_words_are_escaped(undrawn):
    nasty = "<script>alert(1)</script>"
    html = page(
        changes={"sentence": nasty, "nearest": "a & b"},
        origin=replace(ORIGIN, cell=nasty, command=nasty, software={nasty: "1"}),
    )
    assert "<script" not in html
    # Title; cell and sentence in the strip; command, cell and software at the end.
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;") == 6
    assert "a &amp; b" in html


def test_names_in_figures_are_escaped_and_no_formulas():
    done = finished()
    odd = "<b>$x_1$ &"
    cameras = tuple(
        replace(camera, name=odd + str(i))
        for i, camera in enumerate(done.calibration.cameras)
    )
    drawn = geometry.frames(done.session, replace(done.calibration, cameras=cameras))
    assert "<b>" not in drawn
    assert "&lt;b&gt;$x_1$ &amp;0" in drawn


def test_the_page_asks_nothing_of_the_network(html):
    allowed = {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
        "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
        "http://purl.org/dc/elements/1.1/",
        "http://creativecommons.org/ns#",
        "http://purl.org/dc/dcmitype/StillImage",
        "https://matplotlib.org/",
    }
    names = set(re.findall(r"https?://[^\"'<> ]+", html))
    # What remains are names of formats and the drawing program, never loaded.
    assert {name for name in names if not name.startswith("https://matplotlib")} <= {
        *allowed
    }
    for loading in (" src=", "@import", "url(http", "<script", "<iframe"):
        assert loading not in html


def test_the_same_result_gives_the_same_bytes(html):
    assert page(photograph=photograph) == html


def test_a_session_without_images_or_certificate_has_a_page(undrawn):
    html = page(origin=replace(ORIGIN, certificate={}))
    assert "The worst markers" not in html
    assert "What the plan promised" not in text_of(html)


def test_an_unseen_view_is_listed_with_its_reason(undrawn):
    done = finished()
    pixels = done.session.pixels.copy()
    covariance = done.session.pixel_covariance.copy()
    pixels[0, 2], covariance[0, 2] = np.nan, np.nan
    pixels[1, 3, 1], covariance[1, 3, 1] = np.nan, np.nan
    session = replace(done.session, pixels=pixels, pixel_covariance=covariance)
    text = text_of(
        render_report(
            evaluation(done),
            *(session, done.cameras, done.calibration, done.track),
            origin=ORIGIN,
            photograph=photograph,
        )
    )
    assert "UNSEEN ABC" in text
    assert "UNSEEN B" in text
    assert "nan" not in text.lower().replace("dominan", "")


@pytest.mark.parametrize("axis", ["CA"])
def test_the_edge_rig_has_a_page(axis):
    html = page(finished(3, axis))
    assert "Normals of the triangle" in html


def test_digits_follow_the_uncertainty():
    assert number(1720.0552, 0.375) == "1720.06"
    assert number(0.00123456, 1.2e-4) == "0.00123"
    assert number(1350.01, 18.0) == "1350"
    assert number(0.5, 0.01, signed=True) == "+0.500"


def test_gates_are_worst_first():
    gates = [
        {"verdict": verdict, "use": use, "name": name}
        for verdict, use, name in (
            ("not run", 0.0, "e"),
            ("good", 0.2, "d"),
            ("good", 0.7, "c"),
            ("bad", 1.5, "a"),
            ("marginal", 0.9, "b"),
        )
    ]
    assert "".join(gate["name"] for gate in gates_worst_first(gates)) == "abcde"


def test_a_lens_is_listed_by_its_coefficients():
    rows = [
        {"name": "left.k1", "unit": "", "value": -0.123, "sigma": 2e-3, "error": 1e-3},
        {"name": "right.k1", "unit": "", "value": 0.0, "sigma": 1.0, "error": None},
    ]
    (row,) = quantities(rows, "left")
    assert row["symbol"] == "k1"
    assert row["value"] == "-0.1230"
    assert row["truth"] == "-0.0010"


def test_what_else_was_estimated_is_listed_by_its_full_name(undrawn):
    extra = {
        "name": "marker_A.x",
        "unit": "mm",
        "value": -64.99,
        "sigma": 0.01,
        "error": None,
    }
    rows = [*evaluation(finished())["result"], extra]
    text = text_of(page(changes={"result": rows}))
    assert "Also estimated" in text
    assert "marker_A.x" in text
    assert "Also estimated" not in text_of(page())


def test_each_mount_has_its_numbers_and_its_stations():
    one, both = page(), page(finished_on_two_mounts())
    assert "How the rig sits on the flange:" in one
    assert "flange_from_triangle_2" not in one
    for mount, what in ((1, "a normal"), (2, "its edge BC")):
        title = f"How the rig sits on the flange, mount {mount} (about {what})"
        assert both.count(title) == 1
    assert both.count("<code>flange_from_triangle_2</code>") == 1
    assert "6 half-turns, 3 with mount 1 and 3 with mount 2 (stations" in both
    assert "mount 1, station 6" in both
    assert "mount 2, station 14" in both
    head = '<th class="n">mount</th>'
    assert (one.count(head), both.count(head)) == (0, 2)
    assert "Also estimated" not in both


def test_half_turns_are_counted_by_mount():
    one, both = finished().session, finished_on_two_mounts().session
    assert (half_turn_words(one), station_mounts(one)) == ("5 half-turns", [])
    words = "6 half-turns, 3 with mount 1 and 3 with mount 2"
    assert half_turn_words(both) == words
    assert station_mounts(both) == ["1"] * 8 + ["2"] * 8
