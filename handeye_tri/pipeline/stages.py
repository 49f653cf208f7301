"""What each stage does: from the session's files to the session's files.

Each stage reads what it needs back from disk, so that a session gives the same
numbers whether it ran in one go or was taken up again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from handeye_tri import storage
from handeye_tri.counting import counted
from handeye_tri.errors import InputError, StorageError
from handeye_tri.pipeline.drawn_robot import drawn_robot
from handeye_tri.pipeline.evaluation import evaluate, judged_track
from handeye_tri.pipeline.execution import Stage
from handeye_tri.pipeline.failing import explained
from handeye_tri.pipeline.run import (
    CAMERAS_SCHEMA,
    HAND_EYE_SCHEMA,
    PLAN_SCHEMA,
    TRUTH_SCHEMA,
    Run,
)
from handeye_tri.storage import codec


def _plan(run: Run) -> tuple[list[str], str]:
    from handeye_tri.plan import certify_stations, plan_motions

    stations = run.folder.header.get("stations_rad_or_m")
    if stations:
        mounts = run.folder.header.get("station_mounts")
        plan = certify_stations(run.designed_cell, run.arms, stations, mounts)
    else:
        plan = plan_motions(
            run.designed_cell,
            run.arms,
            run.seed,
            half_turns=int(run.folder.header["half_turns"]),
            progress=run.progress.advance,
        )
    storage.write_json(
        run.folder.file("plan.json"),
        {"schema": PLAN_SCHEMA, **codec.plan_to_json(plan)},
    )
    held_out = sum(s.kind == "evaluation" for s in plan.stations)
    return ["plan.json"], (
        f"{counted(len(plan.half_turns), 'half-turn')}, "
        f"{counted(len(plan.stations) - held_out, 'station')} + {held_out} held out, "
        f"{'a tool change, ' if plan.tool_change else ''}"
        f"{plan.certificate['cycle_time_s']:.0f} s; expect "
        f"{plan.certificate['track_predicted_rms_mm']:.3f} mm rms; {plan.outcome}"
    )


def _check_rendering() -> None:
    from handeye_tri.simulate import check_rendering

    check_rendering()


def _simulate(run: Run) -> tuple[list[str], str]:
    from concurrent.futures import ThreadPoolExecutor

    from handeye_tri import simulate

    plan = run.plan()
    joints = simulate.execute(run.arm, plan, run.cell.repeatability, run.seed)
    truth = simulate.ground_truth(run.designed_cell, run.arm, joints)
    storage.write_json(
        run.folder.file("truth.json"),
        {"schema": TRUTH_SCHEMA, **codec.truth_to_json(truth, joints)},
    )
    names = [camera.name for camera in run.cell.cameras]
    views = [(i, j) for j in range(len(plan.stations)) for i in range(len(names))]
    # Views that an interrupted run left are used only if they are of this very task.
    mounts = [station.mount for station in plan.stations]
    task = {"joints": joints.tolist(), "cell": run.folder.header["cell"]}
    task |= {"mounts": mounts, "seed": run.seed}
    started = storage.fingerprint(task).encode()
    mark = run.folder.file("images/.started")
    missing = views
    if mark.is_file() and mark.read_bytes() == started:
        missing = [
            (i, j)
            for i, j in views
            if not run.folder.file(run.image_name(names[i], j)).is_file()
        ]
    else:
        for old in run.folder.file("images").glob("*.png"):
            old.unlink()
        storage.write_bytes(mark, started)
    done = len(views) - len(missing)
    with ThreadPoolExecutor(1) as writer:
        pending = []
        for i, j, image in simulate.render_views(
            *(run.designed_cell, run.model_path, joints, run.seed, missing),
            mounts=mounts,
        ):
            path = run.folder.file(run.image_name(names[i], j))
            pending.append(writer.submit(storage.write_image, path, image))
            done += 1
            run.progress.advance(done, len(views))
        for future in pending:
            future.result()
    mark.unlink()
    outputs = ["truth.json", *(run.image_name(names[i], j) for i, j in views)]
    return outputs, (
        f"{counted(len(plan.stations), 'station')}, {counted(len(views), 'image')}"
    )


def _detect(run: Run) -> tuple[list[str], str]:
    from handeye_tri.detect import MarkerSpec, detect_markers

    spec = MarkerSpec.from_rig(run.cell.rig)
    cameras = run.cell.cameras
    stations = len(run.plan().stations)
    pixels = np.full((len(cameras), stations, 3, 2), np.nan)
    covariance = np.full((len(cameras), stations, 3, 2, 2), np.nan)
    edges = np.full((len(cameras), stations, 3, 3), np.nan)
    for i, camera in enumerate(cameras):
        for j in range(stations):
            name = run.image_name(camera.name, j)
            if not run.was_taken(camera.name, j):
                continue
            image = run.image(camera.name, j)
            if image.shape[1::-1] != camera.image_size_px:
                raise InputError(
                    f"{run.folder.file(name)}: the image is "
                    f"{image.shape[1]} x {image.shape[0]} pixels, the cell says "
                    f"{camera.image_size_px[0]} x {camera.image_size_px[1]}"
                )
            found = detect_markers(image, spec)
            pixels[i, j], covariance[i, j] = found.pixels, found.covariance
            edges[i, j] = found.edges
            run.progress.advance(i * stations + j + 1, len(cameras) * stations)
    storage.write_arrays(
        run.folder.file("observations.npz"),
        {"pixels": pixels, "pixel_covariance": covariance, "edges": edges},
    )
    seen = np.isfinite(pixels).all(axis=-1)
    lacking = [
        f"station {j} lacks {'ABC'[k]} ({cameras[i].name})"
        for i, j, k in np.argwhere(~seen)
    ]
    sigma = float(np.sqrt(np.nanmedian(covariance[..., [0, 1], [0, 1]])))
    line = f"{int(seen.sum())} of {seen.size} markers, sigma {sigma:.3f} px"
    if lacking:
        line += "; " + "; ".join(lacking[:3]) + (" ..." if len(lacking) > 3 else "")
    return ["observations.npz"], line


def _cameras(run: Run) -> tuple[list[str], str]:
    from handeye_tri.calibrate_cameras import calibrate_session_cameras

    with explained(run):
        result = calibrate_session_cameras(run.observed())
    storage.write_json(
        run.folder.file("cameras.json"),
        {"schema": CAMERAS_SCHEMA, **codec.camera_calibration_to_json(result)},
    )
    line = (
        f"{', '.join(camera.name for camera in result.cameras)} from "
        f"{counted(len(run.plan().half_turns), 'half-turn')}; "
        f"chi2/dof {result.chi2 / result.dof:.2f} (1 = noise as assumed)"
    )
    for one in result.details["dropped"]:
        line += f"; dropped {one}"
    return ["cameras.json"], line


def _hand_eye(run: Run) -> tuple[list[str], str]:
    from handeye_tri.pipeline.robot import calibrated_cell, robot_parameters

    parameters = robot_parameters(run)
    with explained(run):
        result = calibrated_cell(run, run.session(), run.cameras())
    storage.write_json(
        run.folder.file("hand_eye.json"),
        {"schema": HAND_EYE_SCHEMA, **codec.hand_eye_to_json(result)},
    )
    translation = 1e3 * np.sqrt((result.residuals[:, :3] ** 2).sum(axis=1).mean())
    rotation = np.degrees(np.sqrt((result.residuals[:, 3:] ** 2).sum(axis=1).mean()))
    errors = ""
    if parameters is not None:
        errors = (
            f", {len(result.robot)} of {len(parameters.labels)} errors of the robot"
        )
    return ["hand_eye.json"], (
        f"{run.method}, {counted(len(result.residuals), 'station')}{errors}; "
        f"loop {translation:.3f} mm {rotation:.4f} deg; "
        f"chi2/dof {result.chi2 / result.dof:.2f}"
    )


def _report(run: Run) -> tuple[list[str], str]:
    from handeye_tri import replay
    from handeye_tri.pipeline.robot import with_robot_applied
    from handeye_tri.pipeline.solver_steps import solver_steps
    from handeye_tri.report import Origin, render_report

    evaluation = run.evaluation()
    track = judged_track(run, run.session(), run.hand_eye()).track
    session, hand_eye = with_robot_applied(run, run.session(), run.hand_eye())
    truth = run.truth()
    drawn = drawn_robot(run, session, hand_eye)
    recording = run.folder.file("replay.rrd")
    replay.write_recording(
        recording,
        name=run.cell.name,
        mechanisms=drawn.mechanisms,
        world_from_body=drawn.world_from_body,
        base_from_world=drawn.base_from_world,
        session=session,
        photograph=run.image,
        calibration=hand_eye,
        track=track,
        truth=truth[0] if truth else None,
        evaluation=evaluation,
        steps=solver_steps(session, run.cameras(), hand_eye),
        dropped=run.cameras().details["dropped"],
    )
    header = run.folder.header
    page = render_report(
        evaluation,
        session,
        run.cameras(),
        hand_eye,
        track,
        origin=Origin(
            cell=run.cell.name,
            seed=run.seed,
            command=run.imported_by
            or f"handeye-tri run {header['cell_file']} -o {run.folder.path} "
            f"--seed {run.seed} --half-turns {header['half_turns']}",
            software=header["software"],
            files={
                name: digest
                for stage in header["stages"]
                for name, digest in run.folder.outputs(stage).items()
                if stage != "report"
            },
            certificate=run.plan().certificate,
        ),
        photograph=run.image,
    )
    storage.write_bytes(run.folder.file("report.html"), page.encode())
    return ["report.html", "replay.rrd"], (
        f"{len(page) / 1e3:.0f} kB page; recording of {len(session.stations)} "
        f"stations, {recording.stat().st_size / 1e6:.1f} MB"
    )


# The triangle, and how it is held.
_HELD = ("rig", "second_mount")

STAGES = {
    stage.name: stage
    for stage in (
        Stage(
            "plan",
            "plan",
            ("arm", *_HELD, "cameras", "surroundings", "plan"),
            (),
            _plan,
            ("stations_rad_or_m", "station_mounts"),
        ),
        Stage(
            "simulate",
            "simulate",
            ("arm", *_HELD, "cameras", "surroundings", "imaging"),
            ("plan",),
            _simulate,
            preflight=_check_rendering,
        ),
        Stage("detect", "detect", ("rig", "cameras"), ("simulate",), _detect),
        Stage("cameras", "calibrate", (*_HELD, "arm"), ("plan", "detect"), _cameras),
        Stage(
            "hand_eye",
            "calibrate",
            (*_HELD, "arm"),
            ("plan", "detect", "cameras"),
            _hand_eye,
            ("method", "robot_errors"),
        ),
        Stage(
            "evaluate",
            "evaluate",
            (*_HELD, "arm", "plan", "track_limit_mm"),
            ("plan", "simulate", "detect", "cameras", "hand_eye"),
            evaluate,
            ("method", "robot_errors"),
        ),
        Stage(
            "report",
            "report",
            ("name", "arm", *_HELD, "cameras", "surroundings"),
            ("plan", "simulate", "detect", "cameras", "hand_eye", "evaluate"),
            _report,
        ),
    )
}


def _not_again(run: Run) -> tuple[list[str], str]:
    raise StorageError(
        f"{run.folder.path}: what was imported is missing or damaged; import it again "
        f"into another folder: {run.imported_by}"
    )


# What stands for the first two stages where their files come from a real robot.
_IMPORTED = {
    name: replace(STAGES[name], verb="import", run=_not_again, preflight=None)
    for name in ("plan", "simulate")
}


def stages_of(run: Run) -> dict[str, Stage]:
    """The stages of a session: all, or those of an imported one."""
    return {**STAGES, **_IMPORTED} if run.imported_by else STAGES


VERBS = tuple(dict.fromkeys(stage.verb for stage in STAGES.values()))
