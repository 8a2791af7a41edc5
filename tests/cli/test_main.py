"""The command line: exit codes, one clear line for every failure, and nothing lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.capture import Capture
from mvdyn_gtsam.cli.main import VERBS, main
from mvdyn_gtsam.cli.progress import progress_line
from mvdyn_gtsam.config import Config, to_dict
from mvdyn_gtsam.demo import demo_capture
from mvdyn_gtsam.errors import ResultError, TrackingError
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior
from mvdyn_gtsam.progress import Progress
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter
from mvdyn_gtsam.resuming import configure

Pipeline = Callable[..., Reconstruction]
Settings = Config | Mapping[str, Any]


def true_poses(camera: str) -> np.ndarray:
    from mvdyn_gtsam.reconstruction.files import read_tum

    return read_tum(demo_capture() / "groundtruth" / f"{camera}.txt")[1]


def begin(capture: Capture, out: Path, config: Settings, resume: bool = False) -> ReconstructionWriter:
    """As the pipeline does."""
    run = configure(out, config, resume=resume)
    run.log()
    info = CaptureInfo.from_capture(capture)
    return ReconstructionWriter.create(out, info, to_dict(run.config), resume=resume)


def oracle(
    capture: Capture,
    out: Path,
    config: Settings,
    *,
    stage: str,
    resume: bool,
    progress: Progress,
    depth_prior: DepthPrior | None,
) -> Reconstruction:
    """Stands in for the pipeline: the true poses, and depth 2 everywhere in every tenth frame."""
    with begin(capture, out, config, resume) as writer:
        writer.set_groups([[camera.name for camera in capture.cameras]])
        for camera in capture.cameras:
            writer.write_trajectory(camera.name, capture.timestamps, true_poses(camera.name))
            for time in range(0, capture.frame_count, 10):
                shape = (camera.height, camera.width)
                writer.write_depth(camera.name, time, np.full(shape, 2.0), np.ones(shape))
                progress.update(stage, min(time + 10, capture.frame_count), capture.frame_count, camera.name)
        writer.finish_stage(stage, 1.0)
    return Reconstruction.load(out)


def failing(error: BaseException) -> Pipeline:
    def pipeline(capture: Capture, out: Path, config: Settings, *, resume: bool, **_: Any) -> Reconstruction:
        with begin(capture, out, config, resume) as writer:
            writer.write_trajectory("cam0", capture.timestamps, true_poses("cam0"))
            raise error

    return pipeline


def nothing(capture: Capture, out: Path, config: Settings, *, resume: bool, **_: Any) -> Reconstruction:
    """Stands in for the pipeline: no pose at all."""
    with begin(capture, out, config, resume) as writer:
        for camera in capture.cameras:
            none = np.full((capture.frame_count, 4, 4), np.nan)
            writer.write_trajectory(camera.name, capture.timestamps, none)
    return Reconstruction.load(out)


@pytest.fixture
def use_pipeline(monkeypatch: pytest.MonkeyPatch) -> Callable[[Pipeline], None]:
    def use(pipeline: Pipeline) -> None:
        module: Any = types.ModuleType("mvdyn_gtsam.pipeline")
        module.reconstruct = pipeline
        monkeypatch.setitem(sys.modules, "mvdyn_gtsam.pipeline", module)

    return use


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error of ``mvdyn ARGUMENTS``."""
    code = main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return code, output.out, output.err


def only_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    assert len(lines) == 1, text
    return lines[0]


def last_line(text: str) -> str:
    return text.rstrip().splitlines()[-1]


def test_help_teaches_and_is_fast() -> None:
    # In a fresh process: nothing heavy may be loaded before a verb needs it.
    script = (
        "import sys; from mvdyn_gtsam.cli.main import main; code = main(['--help'])\n"
        "heavy = {'numpy', 'cv2', 'gtsam', 'scipy', 'pycolmap', 'matplotlib', 'viser'}\n"
        "print(sorted(heavy & set(sys.modules)), code)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert last_line(done.stdout) == "[] 0"
    for verb in ("reconstruct", "batch", "evaluate", "compare", "export", "view", "demo", "scene", "config"):
        assert f"    {verb}" in done.stdout


def test_blas_is_kept_to_one_thread_unless_told_otherwise() -> None:
    script = (
        "import os; from mvdyn_gtsam.cli.main import main; main(['config', '--toml'])\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    for given, expected in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"} | given
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        assert last_line(done.stdout) == expected


def test_importing_the_package_is_cheap() -> None:
    script = "import sys, mvdyn_gtsam; print('numpy' in sys.modules, mvdyn_gtsam.Reconstruction.__name__)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "Reconstruction"]


@pytest.mark.parametrize("verb", [module.__name__.rsplit(".", 1)[-1] for module in VERBS])
def test_every_verb_explains_itself_with_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, verb, "--help")
    assert code == 0 and f"mvdyn {verb}" in out.split("example")[1]


@pytest.mark.parametrize("module", ["mvdyn_gtsam", "mvdyn_gtsam.cli.main"])
def test_runs_as_a_module(module: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", module, "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("mvdyn 0.")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["reconstruct", "clip"], "the following arguments are required: --out"),
        (["reconstruct", "clip", "--out", "o", "--resum"], "unrecognized arguments: --resum"),
        (
            ["reconstruct", "clip", "--out", "o", "--resume", "--overwrite"],
            "not allowed with argument --resume",
        ),
        (["export", "o", "--format", "usd"], "invalid choice: 'usd'"),
        (["reconstrct"], "invalid choice: 'reconstrct'"),
    ],
)
def test_wrong_command_lines_are_one_line_and_exit_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, *arguments)
    assert code == 2 and message in only_line(err) and "--help" in err


def test_no_verb_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys)
    assert code == 2 and "start here" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing", "--out", "{tmp}/o"], "missing: there is no such file or folder"),
        (["--out", "{tmp}/o"], "no input: give a CAPTURE folder"),
        (["--out", "{tmp}/o", "--estimate-focal"], "and --estimate-focal where intrinsics are not known"),
        (["{demo}", "--out", "{tmp}/o", "--set", "tracking.windw=3"], "did you mean tracking.window?"),
        (["{demo}", "--out", "{tmp}/o", "--config", "none.toml"], "none.toml: cannot be read"),
        (["{demo}", "--out", "{tmp}"], "not empty and not a reconstruction"),
        (["{demo}", "--camera", "a.mp4", "--out", "{tmp}/o"], "either a CAPTURE folder or --camera"),
        (
            ["--camera", "a.mp4", "--intrinsics", "1,2,3", "--out", "{tmp}/o"],
            "--intrinsics 1,2,3: write four",
        ),
        (["--camera", "a.mp4", "--out", "{tmp}/o"], "1 cameras but 0 intrinsics; give one per camera"),
        (["--camera", "a.mp4", "--out", "{tmp}/o"], "or none with --estimate-focal"),
        (["--camera", "a.mp4", "--estimate-focal", "--out", "{tmp}/o"], "a.mp4: there is no such file"),
        (
            [
                *("--camera", "a.mp4", "--camera", "b.mp4", "--intrinsics", "1,1,1,1"),
                *("--estimate-focal", "--out", "{tmp}/o"),
            ],
            "2 cameras but 1 intrinsics",
        ),
        (["--camera", "a.mp4", "--intrinsics", "1,1,1,1", "--out", "{tmp}/o"], "a.mp4"),
        (
            ["{demo}", "--out", "{tmp}/o", "--depth-prior", "{tmp}/none"],
            "none: no such folder; a depth prior is",
        ),
        (["{demo}", "--out", "{tmp}/o", "--depth-prior", "{tmp}"], "cam0: is missing; the depth prior needs"),
    ],
)
def test_bad_input_is_one_line_exit_1_and_leaves_nothing(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("x")
    filled = [word.format(tmp=tmp_path, demo=demo_capture()) for word in arguments]
    code, out, err = run(capsys, "reconstruct", *filled)
    assert code == 1 and out == ""
    assert only_line(err).startswith("mvdyn: ") and message in err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_reconstruct(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(oracle)
    out = tmp_path / "o"
    code, said, err = run(capsys, "reconstruct", demo_capture(), "--out", out, "--set", "tracking.window=20")
    assert code == 0
    assert "82 of 82 frames have a pose" in said
    assert "2 cameras x 41 frames, 512x384, 30 fps" in err
    assert "refinement 41/41 (100 %)" in err
    assert Reconstruction.load(out).manifest["config"]["tracking"]["window"] == 20
    # Again: only with --resume or --overwrite.
    code, _, err = run(capsys, "reconstruct", demo_capture(), "--out", out)
    assert code == 1 and "--resume" in only_line(err)
    assert run(capsys, "reconstruct", demo_capture(), "--out", out, "--overwrite")[0] == 0
    assert Reconstruction.load(out).manifest["config"]["tracking"]["window"] == 25


def test_a_folder_of_depths_becomes_the_prior(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    taken: list[DepthPrior | None] = []

    def pipeline(*arguments: Any, depth_prior: DepthPrior | None, **options: Any) -> Reconstruction:
        taken.append(depth_prior)
        return oracle(*arguments, depth_prior=depth_prior, **options)

    use_pipeline(pipeline)
    depth = np.linspace(1.0, 2.0, 96 * 128).reshape(96, 128)
    for name in ("cam0", "cam1"):
        (tmp_path / "depth" / name).mkdir(parents=True)
        np.save(tmp_path / "depth" / name / "000003.npy", depth)
    words = ["reconstruct", demo_capture(), "--out", tmp_path / "o", "--depth-prior", tmp_path / "depth"]
    assert run(capsys, *words)[0] == 0
    assert taken[0] is not None
    found = taken[0].predict(np.zeros((384, 512, 3), np.uint8), np.eye(3), "cam1", 3)
    assert found is not None and found[0].shape == (384, 512) and found[1] is None
    assert run(capsys, *words[:-2], "--overwrite")[0] == 0 and taken[1] is None


def test_resume_goes_on_with_the_settings_the_run_began_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(oracle)
    out = tmp_path / "o"
    words = ["reconstruct", demo_capture(), "--out", out, "--stage", "tracking"]
    assert run(capsys, *words, "--set", "tracking.window=40", "--set", "tracking.free=30")[0] == 0
    manifest = json.loads((out / "manifest.json").read_text())
    manifest["config"]["tracking"]["gone"] = 7
    del manifest["config"]["tracking"]["step_iterations"]
    (out / "manifest.json").write_text(json.dumps(manifest))
    before = (out / "manifest.json").read_bytes()

    words += ["--resume"]
    code, _, err = run(capsys, *words, "--set", "tracking.window=25")
    assert code == 1 and (out / "manifest.json").read_bytes() == before
    assert only_line(err) == (
        f"mvdyn: {out}: what is finished was made with tracking.window=40, not 25; leave that out to go on,"
        " or start anew in another folder"
    )
    # 30 of 40 frames, though 30 of the default's 25 would be refused
    code, _, err = run(capsys, *words, "--set", "tracking.free=30", "--set", "refinement.stride=4")
    assert code == 0
    err = " ".join(err.split())
    assert "settings that this version does not take are left out: tracking.gone=7 " in err
    assert "not the defaults: tracking.window=40, tracking.free=30 " in err
    made = Reconstruction.load(out).manifest["config"]
    assert made == {**to_dict(Config()), "tracking": made["tracking"], "refinement": made["refinement"]}
    assert (made["tracking"]["window"], made["tracking"]["free"], made["refinement"]["stride"]) == (40, 30, 4)
    assert made["tracking"]["step_iterations"] == Config().tracking.step_iterations
    code, _, err = run(capsys, *words, "--set", "tracking.windw=25")
    assert code == 1 and "--set" in only_line(err) and "did you mean tracking.window?" in err


def test_resume_cuts_cameras_as_the_run_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    for name, count in (("cam0", 4), ("cam1", 3)):
        (tmp_path / name).mkdir()
        for number in range(count):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((32, 48, 3), 40 * number, np.uint8))
    words: list[object] = ["reconstruct", "--fps", 10, "--out", tmp_path / "o", "--stage", "tracking"]
    for name in ("cam0", "cam1"):
        words += ["--camera", tmp_path / name / "*.png", "--intrinsics", "40,40,23.5,15.5"]
    use_pipeline(nothing)
    assert run(capsys, *words, "--truncate")[0] == 0
    assert run(capsys, *words, "--resume")[0] == 0
    assert Reconstruction.load(tmp_path / "o").frame_count == 3


def test_reconstruct_from_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(oracle)
    words: list[object] = []
    for name in ("cam0", "cam1"):
        words += ["--camera", demo_capture() / f"{name}.mp4", "--intrinsics", "396,395,255.5,191.5"]
    assert run(capsys, "reconstruct", *words, "--out", tmp_path / "o")[0] == 0
    result = Reconstruction.load(tmp_path / "o")
    assert result.cameras == ["cam0", "cam1"]
    np.testing.assert_array_equal(result.intrinsics("cam1"), [[396, 0, 255.5], [0, 395, 191.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["{demo}"], (396.0, 255.5, 191.5)),
        (["--camera", "{demo}/cam0.mp4", "--camera", "{demo}/cam1.mp4"], (0.75 * 512, 255.5, 191.5)),
        (
            [*("--camera", "{demo}/cam0.mp4", "--intrinsics", "396,395,250,190"),
             *("--camera", "{demo}/cam1.mp4", "--intrinsics", "396,395,250,190")],
            (396.0, 250.0, 190.0),
        ),
    ],
)  # fmt: skip
def test_focal_lengths_may_be_left_to_find(
    words: list[str],
    expected: tuple[float, float, float],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    use_pipeline: Callable[[Pipeline], None],
) -> None:
    taken: list[Capture] = []

    def pipeline(capture: Capture, *arguments: Any, **options: Any) -> Reconstruction:
        taken.append(capture)
        return oracle(capture, *arguments, **options)

    use_pipeline(pipeline)
    filled = [word.format(demo=demo_capture()) for word in words]
    code, _, err = run(capsys, "reconstruct", *filled, "--out", tmp_path / "o", "--estimate-focal")
    assert code == 0 and "focal length to be found in the video: cam0, cam1" in err, err
    for camera in taken[0].cameras:
        assert not camera.focal_known and camera.fx == camera.fy
        assert (camera.fx, camera.cx, camera.cy) == pytest.approx(expected, abs=1.5)
    assert run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "known")[0] == 0
    assert all(camera.focal_known for camera in taken[1].cameras)


def test_a_failing_run_keeps_what_it_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(failing(TrackingError("cam1: no frame matches any other")))
    code, _, err = run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "o")
    assert code == 1 and last_line(err) == "mvdyn: cam1: no frame matches any other"
    result = Reconstruction.load(tmp_path / "o")
    assert result.status == "failed" and np.isfinite(result.trajectory("cam0")[1]).all()


def test_ctrl_c_says_where_the_partial_result_lies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(failing(KeyboardInterrupt()))
    out = tmp_path / "o"
    code, _, err = run(capsys, "reconstruct", demo_capture(), "--out", out)
    assert code == 130
    assert f"interrupted; what was finished is in {out}" in last_line(err) and "--resume" in last_line(err)
    assert Reconstruction.load(out).status == "interrupted"


def test_a_polite_kill_is_an_interruption(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    def killed(capture: Capture, out: Path, config: Settings, **_: Any) -> Reconstruction:
        with begin(capture, out, config):
            os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("the signal was ignored")

    use_pipeline(killed)
    before = signal.getsignal(signal.SIGTERM)
    assert run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "o")[0] == 130
    assert Reconstruction.load(tmp_path / "o").status == "interrupted"
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_bug_is_one_line_and_a_hint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    use_pipeline(failing(IndexError("index 3\nis out of range")))
    code, _, err = run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "o")
    assert code == 3 and "Traceback" not in err
    assert last_line(err).startswith(
        "mvdyn: internal error: IndexError: index 3 is out of range; run again with --debug"
    )
    code, _, err = run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "o", "--resume", "--debug")
    assert code == 3 and "Traceback" in err


def test_a_disk_too_small_is_said_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = types.SimpleNamespace(total=10, used=9, free=1_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    words = ["reconstruct", demo_capture(), "--out", tmp_path / "o"]
    code, _, err = run(capsys, *words)
    assert code == 1 and "the disk has 1 MB left" in only_line(err)
    for name in ("cam0", "cam1"):
        (tmp_path / "depth" / name).mkdir(parents=True)
        np.save(tmp_path / "depth" / name / "000003.npy", np.ones((384, 512)))
    # 2 x 41 x 512 x 384 bytes, and eight times as many of the prior
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(total=0, used=0, free=1e8))
    code, _, err = run(capsys, *words, "--depth-prior", tmp_path / "depth")
    assert code == 1 and "16 MB and its depth prior up to 129 MB until tracking is done" in only_line(err)


@pytest.fixture
def made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> Path:
    use_pipeline(oracle)
    assert run(capsys, "reconstruct", demo_capture(), "--out", tmp_path / "made")[0] == 0
    return tmp_path / "made"


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("tum", ["tum/cam0.txt", "tum/cam1.txt"]),
        ("ply", ["ply/robodog.ply"]),
        ("colmap", ["colmap/sparse/0"]),
        ("nerfstudio", ["nerfstudio/transforms.json"]),
    ],
)
def test_export(kind: str, expected: list[str], made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [] if kind == "tum" else ["--times", "10", "--capture", demo_capture()]
    code, out, err = run(capsys, "export", made, "--format", kind, *options)
    assert code == 0 and err == ""
    paths = [made / "exports" / name for name in expected]
    assert out.split() == [str(path) for path in paths] and all(path.exists() for path in paths)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "ply", "--times", "99"], "no frame 99"),
        (["--format", "tum", "--times", "1"], "a trajectory is written whole"),
        (["--format", "ply", "--stride", "0"], "must be at least 1"),
        (["--format", "ply", "--capture", "gone"], "gone"),
    ],
)
def test_export_refuses(
    options: list[str], message: str, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, "export", made, *options)
    assert code == 1 and out == "" and message in only_line(err)


def test_export_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "export", tmp_path / "none", "--format", "tum")
    assert code == 1 and "no such folder" in only_line(err)


def test_evaluate(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("evo", reason="evo, the eval extra, is not installed")
    scores = tmp_path / "scores.json"
    truth = demo_capture() / "groundtruth"
    code, out, _ = run(
        capsys, "evaluate", made, "--groundtruth", truth, "--json", scores, "--plots", tmp_path / "p"
    )
    assert code == 0 and "cam1" in out
    figures = json.loads(scores.read_text())
    assert figures["registered"] == 1.0 and figures["ate_m"] < 1e-6
    assert (tmp_path / "p" / "trajectories.png").is_file()
    code, _, err = run(capsys, "evaluate", made, "--groundtruth", tmp_path / "none")
    assert code == 1 and "none" in only_line(err)


@pytest.mark.slow
def test_demo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], use_pipeline: Callable[[Pipeline], None]
) -> None:
    pytest.importorskip("evo", reason="evo, the eval extra, is not installed")
    use_pipeline(oracle)
    out = tmp_path / "demo"
    with ReconstructionWriter.create(out, CaptureInfo("robodog", 30.0, 41, ()), {}):
        pass  # an earlier demo, which is replaced
    code, said, _ = run(capsys, "demo", "--out", out)
    assert code == 0
    assert f"mvdyn view {out}, to look at it in 3D\n" in said
    pictures = [line.strip() for line in said.split("look at:")[1].splitlines() if line.strip()]
    assert all(Path(path).is_file() for path in pictures)
    assert {"trajectories.png", "depth.png", "scores.json"} <= {Path(path).name for path in pictures}
    sheet: Any = cv2.imread(str(out / "pictures" / "depth.png"))
    assert sheet.shape == (4 * 192, 5 * 256, 3)


def test_demo_never_replaces_another_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("evo", reason="evo, the eval extra, is not installed")
    from mvdyn_gtsam.capture.model import Camera

    info = CaptureInfo("precious", 30.0, 1, (Camera("cam0", 4, 4, 1.0, 1.0, 1.5, 1.5),))
    with ReconstructionWriter.create(tmp_path / "o", info, {}):
        pass
    code, _, err = run(capsys, "demo", "--out", tmp_path / "o")
    assert code == 1 and "holds the reconstruction of another capture" in only_line(err)
    assert Reconstruction.load(tmp_path / "o").name == "precious"


def test_config_lists_and_its_toml_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "config", "--toml", "--set", "tracking.window=21")
    file = tmp_path / "c.toml"
    file.write_text(out)
    from mvdyn_gtsam.config import load_config

    assert code == 0 and load_config(file) == load_config(None, ["tracking.window=21"])
    code, out, _ = run(capsys, "config", "--config", file)
    assert code == 0 and "21 (default 25)" in out
    code, _, err = run(capsys, "config", "--set", "nothing.here=1")
    assert code == 1 and "unknown key nothing.here" in only_line(err)


def test_compare_reports_what_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mvdyn_gtsam import baselines

    asked: dict[str, Any] = {}

    def compare(capture: Path, groundtruth: Path, methods: list[str], out: Path, **options: Any) -> Any:
        asked.update(options, capture=capture, groundtruth=groundtruth, methods=methods)
        rows = [
            baselines.MethodResult(name, problem, None, 1.0, 1.0, 10.0, out / name)
            for name, problem in (("ours", None), ("colmap", "found no model"))
        ]
        return baselines.Comparison("robodog", tuple(rows if "ours" in methods else rows[1:]))

    monkeypatch.setattr(baselines, "compare", compare)
    words = ["compare", demo_capture(), "--out", tmp_path, "--set", "tracking.window=19"]
    code, out, err = run(capsys, *words, "--methods", "ours,colmap")
    assert code == 0, err
    assert "robodog" in out and "colmap" in out
    assert asked["methods"] == ["ours", "colmap"] and asked["our_arguments"] == [
        "--set",
        "tracking.window=19",
    ]
    assert asked["groundtruth"] == demo_capture() / "groundtruth"
    code, _, err = run(capsys, *words, "--methods", "colmap")
    assert code == 1 and "colmap failed: found no model" in last_line(err)
    code, _, err = run(capsys, *words, "--set", "tracking.windw=19")
    assert code == 1 and "did you mean" in only_line(err)


def test_full_disk_while_exporting(
    made: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    code, _, err = run(capsys, "export", made, "--format", "tum")
    assert code == 1 and "disk is full" in only_line(err)


def test_progress_lines() -> None:
    assert progress_line("tracking", 10, 40, "cam0", 10.0) == "tracking 10/40 (25 %), 30 s left: cam0"
    assert progress_line("tracking", 40, 40, "", 12.4) == "tracking 40/40 (100 %), took 12 s"
    assert progress_line("start", 0, 8, "", 0.0) == "start 0/8 (0 %)"


def test_result_errors_reach_the_user_unchanged(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (made / "manifest.json").write_text("{")
    with pytest.raises(ResultError) as caught:
        Reconstruction.load(made)
    code, _, err = run(capsys, "export", made, "--format", "tum")
    assert code == 1 and only_line(err) == f"mvdyn: {caught.value}"
