"""Every experiment explains itself and refuses what it cannot run."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

SCRIPTS = ("accuracy", "factor_cost", "flow_accuracy", "focal", "scaling", "wide_baseline")
LONG = ("accuracy", "focal", "scaling", "wide_baseline")


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_names_the_options(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module(f"experiments.{name}")
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as stopped:
        module.main()
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert module.__doc__ is not None and module.__doc__.splitlines()[0] in text
    assert "--" in text.replace("--help", "")


@pytest.mark.parametrize("name", LONG)
def test_a_missing_capture_is_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"experiments.{name}")
    arguments = [str(tmp_path / "nowhere"), "--results", str(tmp_path / "results")]
    assert module.main(arguments) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert "nowhere" in lines[-1]
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("name", LONG)
def test_an_unknown_setting_is_refused_before_any_work(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = importlib.import_module(f"experiments.{name}")
    arguments = [str(tmp_path), "--results", str(tmp_path / "results"), "--set", "tracking.windwo=3"]
    assert module.main(arguments) == 1
    error = capsys.readouterr().err
    assert "tracking.window" in error and "running" not in error


def test_every_script_is_in_the_index() -> None:
    folder = Path(__file__).parents[2] / "experiments"
    index = (folder / "README.md").read_text()
    scripts = {path.stem for path in folder.glob("*.py") if "__main__" in path.read_text()}
    assert scripts
    assert [name for name in sorted(scripts) if f"experiments.{name}" not in index] == []
