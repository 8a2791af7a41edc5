"""A run goes on with the configuration it began with, whatever became of the defaults since."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from mvdyn_gtsam.config import Config, load_config, to_dict
from mvdyn_gtsam.config_tree import flatten, nest
from mvdyn_gtsam.errors import ConfigError, ResultError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter
from mvdyn_gtsam.resuming import DECIDES_NOTHING, SECTIONS, configure, resumed, resumed_prior

TRACKED = ("start", "tracking")
REFINED = (*TRACKED, "refinement")


def saved(changes: dict[str, Any] | None = None, without: str | None = None) -> dict[str, Any]:
    """A recorded configuration: today's, but for ``changes``."""
    flat = {**flatten(to_dict(Config())), **(changes or {})}
    return nest({key: value for key, value in flat.items() if key != without})


def test_without_a_change_everything_is_as_it_was() -> None:
    run = resumed(saved(), REFINED, {})
    assert run.config == Config()
    assert (run.changed, dict(run.removed), dict(run.kept)) == ((), {}, {})


@pytest.mark.parametrize("finished", [(), ("start",), TRACKED, REFINED])
def test_a_default_that_changed_since_is_not_taken(finished: tuple[str, ...]) -> None:
    run = resumed(saved({"tracking.window": 40, "refinement.stride": 4}), finished, {})
    assert (run.config.tracking.window, run.config.refinement.stride) == (40, 4)
    assert run.changed == () and run.kept == {"tracking.window": 40, "refinement.stride": 4}


@pytest.mark.parametrize("finished", [(), REFINED])
def test_a_setting_that_is_new_takes_its_default(finished: tuple[str, ...]) -> None:
    run = resumed(saved({"tracking.free": 9}, without="tracking.window"), finished, {})
    assert run.config == load_config(None, ["tracking.free=9"])
    assert run.changed == ("tracking.window",)


def test_a_section_that_is_new_takes_its_defaults() -> None:
    old = saved()
    del old["graph"]
    assert resumed(old, TRACKED, {}).config == Config()


@pytest.mark.parametrize("finished", [(), REFINED])
def test_settings_that_are_no_more_are_left_out_and_named(
    finished: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    gone = {"tracking.gone": 7, "old.inner.a": True, "tracking.depth_model": "round"}
    run = resumed(saved(gone), finished, {})
    assert run.config == Config() and run.removed == gone
    assert run.changed == tuple(sorted(gone))
    with caplog.at_level(logging.INFO):
        run.log()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    for word in ("tracking.gone=7", "old.inner.a=true", 'tracking.depth_model="round"'):
        assert word in caplog.text


@pytest.mark.parametrize("finished", [(), ("start",), TRACKED, REFINED])
def test_what_is_asked_for_and_was_so_is_accepted(finished: tuple[str, ...]) -> None:
    asked = {"tracking": {"window": 40}, "graph": {"spatial_overlap": 1}, "refinement": {"stride": 4}}
    run = resumed(saved({**flatten(asked), "graph.spatial_overlap": 1.0}), finished, asked)
    assert run.config.tracking.window == 40 and run.changed == ()


@pytest.mark.parametrize(
    ("key", "value", "stage"),
    [
        ("frontend.wide_baseline.features", 999, "start"),
        ("frontend.flow.patch_size", 9, "start"),
        ("graph.st_per_frame", 2, "tracking"),
        ("tracking.window", 40, "tracking"),
        ("refinement.stride", 4, "refinement"),
        ("refinement.sweep.levels", 20, "refinement"),
    ],
)
def test_what_is_asked_for_is_refused_from_the_stage_on_that_used_it(
    key: str, value: Any, stage: str
) -> None:
    asked, default = nest({key: value}), flatten(to_dict(Config()))[key]
    for count in range(len(REFINED) + 1):
        finished = REFINED[:count]
        if stage not in finished:
            run = resumed(saved(), finished, asked)
            assert flatten(to_dict(run.config))[key] == value and run.changed == (key,)
            continue
        with pytest.raises(ResultError) as caught:
            resumed(saved(), finished, asked)
        assert str(caught.value) == (
            f"what is finished was made with {key}={default}, not {value}; leave that out to go on, or start"
            " anew in another folder"
        )


def test_the_default_can_be_asked_for() -> None:
    asked = {"tracking": {"window": 25, "free": 10}}
    assert resumed(saved({"tracking.window": 40}), ("start",), asked).config == Config()
    with pytest.raises(ResultError, match=r"window=40, not 25, tracking\.free=9, not 10; leave these out"):
        resumed(saved({"tracking.window": 40, "tracking.free": 9}), TRACKED, asked)


def test_another_value_of_a_new_setting_is_refused_where_a_finished_stage_did_without() -> None:
    old = saved(without="tracking.step_iterations")
    asked = {"tracking": {"step_iterations": 5}}
    with pytest.raises(ResultError, match=r"tracking\.step_iterations=2, not 5"):
        resumed(old, TRACKED, asked)
    assert resumed(old, ("start",), asked).config.tracking.step_iterations == 5


def test_what_decides_nothing_may_change_at_any_time() -> None:
    asked = {"refinement": {"workers": 3}, "tracking": {"image_cache_mb": 5}, "capture": {"truncate": True}}
    assert set(flatten(asked)) == DECIDES_NOTHING
    run = resumed(saved(), REFINED, asked)
    assert run.changed == ()
    assert (run.config.refinement.workers, run.config.capture.truncate) == (3, True)


def test_every_section_belongs_to_a_stage() -> None:
    used = {section for sections in SECTIONS.values() for section in sections}
    assert used == set(to_dict(Config())) - {"capture"}


def test_values_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(ResultError, match=r"tracking\.free is 10; it must be between 1 .*another folder"):
        resumed(saved(), ("start",), {"tracking": {"window": 5}})


def test_the_result_of_another_method_is_refused() -> None:
    with pytest.raises(ResultError, match="was not made by mvdyn reconstruct"):
        resumed({"baseline": {"method": "colmap"}}, ("mapping",), {})


def test_the_folder_decides_and_is_named(tmp_path: Path) -> None:
    out = tmp_path / "out"
    asked = {"tracking": {"window": 30}}
    for resume in (False, True):  # nothing there: a new run
        run = configure(out, asked, resume=resume)
        assert run.config.tracking.window == 30 and run.changed == ()
    assert configure(out, run.config, resume=True).config is run.config
    with ReconstructionWriter.create(out, CaptureInfo("c", 30.0, 1, ()), to_dict(run.config)) as writer:
        for stage in TRACKED:
            writer.finish_stage(stage, 1.0)
    assert configure(out, None, resume=True).config == run.config
    assert configure(out, {}, resume=True).config == run.config
    assert configure(out, Config(), resume=True).config == run.config
    with pytest.raises(ResultError, match=r"out: what is finished was made with tracking\.window=30, not 20"):
        configure(out, load_config(None, ["tracking.window=20"]), resume=True)
    with pytest.raises(ConfigError, match="unknown key"):
        configure(out, {"tracking": {"windw": 20}}, resume=True)
    assert configure(out, None, resume=False).config == Config()


def begun(out: Path, prior: str | None, finished: tuple[str, ...]) -> None:
    """A run with or without a depth prior."""
    info = CaptureInfo("c", 30.0, 1, ())
    with ReconstructionWriter.create(out, info, to_dict(Config()), depth_prior=prior) as writer:
        for stage in finished:
            writer.finish_stage(stage, 1.0)


def test_a_run_with_a_depth_prior_needs_it_until_tracking_is_finished(tmp_path: Path) -> None:
    begun(tmp_path / "begun", "A", ("start",))
    with pytest.raises(ResultError, match=r"begun: began with the depth prior A; give it again"):
        resumed_prior(tmp_path / "begun", None, resume=True)
    assert resumed_prior(tmp_path / "begun", "A", resume=True) == "A"
    assert resumed_prior(tmp_path / "begun", "B", resume=True) == "B"  # tracking begins anew, with that
    begun(tmp_path / "tracked", "A", TRACKED)
    for asked in (None, "A"):
        assert resumed_prior(tmp_path / "tracked", asked, resume=True) == "A"
    with pytest.raises(
        ResultError, match=r"tracked: .* with the depth prior A, not the depth prior B; leave"
    ):
        resumed_prior(tmp_path / "tracked", "B", resume=True)


def test_a_run_without_a_depth_prior_takes_one_until_tracking_is_finished(tmp_path: Path) -> None:
    begun(tmp_path / "begun", None, ("start",))
    begun(tmp_path / "tracked", None, TRACKED)
    for name in ("begun", "tracked", "nothing"):
        assert resumed_prior(tmp_path / name, None, resume=True) is None
    assert resumed_prior(tmp_path / "begun", "A", resume=True) == "A"
    with pytest.raises(ResultError, match="with no depth prior, not the depth prior A; leave that out"):
        resumed_prior(tmp_path / "tracked", "A", resume=True)
    for name in ("begun", "tracked", "nothing"):
        assert resumed_prior(tmp_path / name, "A", resume=False) == "A"
