"""What a recording says in words, from the numbers that it carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from handeye_tri.records import TrackEvaluation
from handeye_tri.replay.steps import Slide
from handeye_tri.replay.story import Story, worst_station
from handeye_tri.triangle import VERTICES

# rerun's names of the levels of a log.
_LEVELS = {"error": "ERROR", "warning": "WARN", "note": "INFO"}


# What half-turns look like in an image, about a normal and about an edge.
_LINES = (
    "White lines AA' BB' CC' join a marker before and after the half-turn and meet in "
    "O.",
    "A white line joins the marker that moves before (X) and after (X') the half-turn; "
    "it meets the edge that is the axis in O.",
)


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of the recording's log.

    Attributes:
        station: Where it stands.
        level: "ERROR", "WARN" or "INFO".
        text: What it says.
    """

    station: int
    level: str
    text: str


def numbers(story: Story, track: TrackEvaluation) -> dict[str, Any]:
    """What a recording carries to be read back, with the units in the keys."""
    return {
        "station_count": len(story.held_out),
        "shown_station": story.shown,
        "step_count": len(story.slides),
        "worst_station": worst_station(track),
        "stations": track.stations.tolist(),
        "markers": track.markers.tolist(),
        "reported_m": track.reported.tolist(),
        "observed_m": track.observed.tolist(),
        "predicted_covariance_m2": track.predicted_covariance.tolist(),
        "mean_mm": 1e3 * track.mean,
        "rms_mm": 1e3 * track.rms,
        "max_mm": 1e3 * track.max,
        "predicted_rms_mm": 1e3 * track.predicted_rms,
    }


def verdict_markdown(
    evaluation: Mapping[str, Any], story: Story, track: TrackEvaluation
) -> str:
    """The verdict, what to look at, and how to read the pictures.

    Args:
        evaluation: The content of ``evaluation.json``.
        story: What is drawn.
        track: The held-out track.
    """
    ran = [gate for gate in evaluation["gates"] if gate["verdict"] != "not run"]
    met = sum(gate["verdict"] != "bad" for gate in ran)
    held_out = evaluation["track"]
    source = (
        "SIMULATED: truth known, used only to score"
        if evaluation["simulated"]
        else "REAL robot"
    )
    lines = [
        f"# {evaluation['verdict']}",
        evaluation["sentence"],
        "",
        *_findings(evaluation["findings"]),
        f"**Look at** {look_at(story, evaluation['findings'])}",
        "",
        f"Held-out track: {held_out['mean_mm']:.3f} mm mean, "
        f"{held_out['rms_mm']:.3f} rms (predicted {held_out['predicted_rms_mm']:.3f}); "
        f"worst at station {worst_station(track)}, marker {held_out['worst_marker']}: "
        f"{held_out['max_mm']:.3f} mm.",
        "",
        f"{met} of {len(ran)} gates met, {len(evaluation['gates']) - len(ran)} not "
        f"run; nearest to failing: {evaluation['nearest']}. {source}.",
        "",
        *_held(story),
        "---",
        _legend(story),
    ]
    return "\n".join(lines)


def look_at(story: Story, findings: Sequence[Mapping[str, Any]]) -> str:
    """The station on screen, and what is to be seen there.

    Args:
        story: What is drawn.
        findings: What is wrong, first first, as in ``evaluation.json``.
    """
    j = story.shown
    marker, gap = story.worst(j)
    kind = "the worst station that was held out"
    if findings and j in findings[0]["stations"]:
        kind = f"where {findings[0]['code']} was found"
    elif not story.held_out[j]:
        kind = "the worst that the calibration used"
    text = f"**station {j}**, {kind}: "
    text += f"marker {marker} is {gap:.3f} mm off" if marker else _unseen(story, j)
    text += "."
    views = [check for check in story.checks if check.station == j and check.worst]
    if views:
        view = views[0]
        text += (
            f" Its image farthest from what is predicted: {view.camera}, {view.worst}, "
            f"{view.worst_px:.3f} px ({view.worst_sigmas:.1f} sigmas)."
        )
    return text


def changes_of_mount(story: Story) -> list[tuple[int, str]]:
    """Stations at which another mount holds the triangle, and what it is called."""
    mounts = story.mounts
    return [(j, mounts[j]) for j in range(1, len(mounts)) if mounts[j] != mounts[j - 1]]


def _held(story: Story) -> list[str]:
    """Which stations have which mount, where there are several."""
    starts = [(0, story.mounts[0]), *changes_of_mount(story)]
    ends = [*(j for j, _ in starts[1:]), len(story.mounts)]
    spans = [
        f"{start}-{end - 1}: {name}"
        for (start, name), end in zip(starts, ends, strict=True)
    ]
    return [f"Stations {'; '.join(spans)}.", ""] if len(spans) > 1 else []


def _unseen(story: Story, j: int) -> str:
    """Why a station has no gap."""
    codes = {check.code for check in story.checks if check.station == j}
    return "left out" if "LEFT OUT" in codes else "no marker seen"


def _findings(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is wrong; what follows from it by its code alone, the log says it all."""
    lines: list[str] = []
    for finding in findings:
        if not finding["follows"]:
            lines += [
                f"**{finding['code']}** {finding['cause']} ({finding['evidence']}). "
                f"Do: {finding['remedy']}.",
                "",
            ]
    symptoms = dict.fromkeys(one["code"] for one in findings if one["follows"])
    if symptoms:
        lines += [f"What likely follows from it: {', '.join(symptoms)}.", ""]
    return lines


def _legend(story: Story) -> str:
    truth = " **Grey**: the truth." if story.actual is not None else ""
    turns = [turn for view in story.turns for turn in view if turn.lines]
    kinds = sorted({turn.edge is not None for turn in turns})
    lines = " ".join(_LINES[by_edge] for by_edge in kinds)
    if len(kinds) > 1:
        lines = f"About a normal: {_LINES[False]} About an edge: {_LINES[True]}"
    return (
        "**Blue**: what was calibrated, and the stations it used. **Orange**: held "
        f"out.{truth}\n\nImages: o where a marker is seen, + where calibration and "
        f"robot put it, the arrow from + to o {story.magnification_px} times too long. "
        f"{lines}\n\nIn space: arrows from where the robot says a marker is to where "
        f"the cameras see it, {story.magnification} times too long.\n\nTimelines "
        "(below): station; step, how the calibration got there; track, the held-out "
        "stations."
    )


def cameras_markdown(evaluation: Mapping[str, Any]) -> str:
    """Every camera's parameters as tables."""
    lines: list[str] = []
    names = _cameras(evaluation)
    for k in range(0, len(names), 2):
        lines += [*_camera_table(names[k : k + 2], evaluation), ""]
    return "\n".join(lines)


def steps_markdown(story: Story) -> str:
    """The solver's steps, as the log has them on their timeline."""
    lines = ["On the timeline **step**, at the bottom left:", ""]
    lines += [f"{k}. {step_words(slide)}" for k, slide in enumerate(story.slides)]
    lines += [
        "",
        f"There the cameras stand {story.magnification_slide} times farther from "
        "their end than they did.",
    ]
    return "\n".join(lines)


def step_words(slide: Slide) -> str:
    """What a solver step reached."""
    text = f"{slide.words}: seen less predicted {slide.rms_px:.3f} px rms"
    if slide.moved_mm > 0:
        text += f", cameras {slide.moved_mm:.3f} mm from their end"
    return text


def _camera_table(names: Sequence[str], evaluation: Mapping[str, Any]) -> list[str]:
    """Parameters of a few cameras side by side."""
    truth = evaluation["simulated"]
    rows: dict[str, list[str]] = {}
    for k, name in enumerate(names):
        for row in evaluation["result"]:
            owner, quantity = row["name"].rsplit(".", 1)
            if owner not in (name, f"base_from_{name}"):
                continue
            places = _places(row["sigma"])
            cells = [f"{row['value']:.{places}f}", f"{row['sigma']:.{places}f}"]
            if truth:
                cells.append(f"{-row['error']:+.{places}f}")
            label = f"{quantity} {row['unit']}".strip()
            # A camera without this quantity leaves its cells empty.
            before = [""] * (k * len(cells))
            rows.setdefault(label, before).extend(cells)
    columns = ["+- 1 sd", *(["truth - value"] if truth else [])]
    head = [cell for name in names for cell in (f"**{name}**", *columns)]
    return [
        f"| | {' | '.join(head)} |",
        "|---" * (1 + len(head)) + "|",
        *(
            f"| {' | '.join([label, *cells, *[''] * (len(head) - len(cells))])} |"
            for label, cells in rows.items()
        ),
    ]


def _cameras(evaluation: Mapping[str, Any]) -> list[str]:
    """Names of the cameras, in order."""
    names = [
        row["name"].rsplit(".", 1)[0].removeprefix("base_from_")
        for row in evaluation["result"]
        if row["name"].startswith("base_from_")
    ]
    return list(dict.fromkeys(names))


def _places(sigma: float) -> int:
    """Decimal places that show a standard deviation by two digits."""
    return max(0, 1 - int(f"{sigma:e}".split("e")[1])) if sigma > 0 else 6


def track_markdown(track: TrackEvaluation, evaluation: Mapping[str, Any]) -> str:
    """The held-out track, row by row."""
    held_out = evaluation["track"]
    lines = [
        f"**{held_out['mean_mm']:.3f} mm mean**, {held_out['rms_mm']:.3f} rms "
        f"(predicted {held_out['predicted_rms_mm']:.3f}), "
        f"{held_out['max_mm']:.3f} worst",
        "",
        "| station | marker | off, mm | robot x, y, z, mm | cameras less robot, mm |",
        "|---|---|---|---|---|",
    ]
    for r, (station, marker) in enumerate(
        zip(track.stations, track.markers, strict=True)
    ):
        where = ", ".join(f"{1e3 * value:.1f}" for value in track.reported[r])
        gap = 1e3 * (track.observed[r] - track.reported[r])
        less = ", ".join(f"{value:+.3f}" for value in gap)
        lines.append(
            f"| {station} | {VERTICES[marker]} | {1e3 * track.distances[r]:.3f} "
            f"| {where} | {less} |"
        )
    return "\n".join(lines)


def log_lines(story: Story, evaluation: Mapping[str, Any]) -> list[LogLine]:
    """Findings at their stations, and how each station came out, in order."""
    lines = []
    for finding in evaluation["findings"]:
        stations = finding["stations"]
        text = f"{finding['code']} {finding['cause']} ({finding['evidence']}). "
        text += (
            f"Likely from {finding['follows']}."
            if finding["follows"]
            else f"Do: {finding['remedy']}."
        )
        level = _LEVELS[finding["severity"]]
        if not stations:
            lines.append(LogLine(0, level, f"All stations: {text}"))
        lines += [LogLine(int(j), level, text) for j in stations]
    for check in story.checks:
        if check.code == "LEFT OUT":
            text = f"{check.camera} was left out of the calibration"
            lines.append(LogLine(check.station, "WARN", text))
        elif check.unseen:
            text = f"{check.camera} does not see {', '.join(check.unseen)}"
            lines.append(LogLine(check.station, "WARN", text))
        if check.code == "FAR":
            text = (
                f"{check.camera} sees {check.worst} {check.worst_px:.3f} px from where "
                f"it is predicted, {check.worst_sigmas:.1f} sigmas"
            )
            lines.append(LogLine(check.station, "WARN", text))
    for j, now in changes_of_mount(story):
        lines.append(LogLine(j, "INFO", f"tool change: {now}"))
    for j, held_out in enumerate(story.held_out):
        marker, gap = story.worst(j)
        kind = "held out" if held_out else "used"
        text = f"{kind}: {f'{marker} {gap:.3f} mm' if marker else _unseen(story, j)}"
        lines.append(LogLine(j, "INFO", text))
    return sorted(lines, key=lambda line: line.station)
