"""Which configuration a run goes on with, where a folder holds what an earlier one finished."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mvdyn_gtsam.config import Config, config_from_dict, given_settings, to_dict
from mvdyn_gtsam.config_tree import flatten, nest, sift, to_plain
from mvdyn_gtsam.errors import ConfigError, ResultError
from mvdyn_gtsam.reconstruction.manifest import is_reconstruction, read_manifest

logger = logging.getLogger(__name__)

SECTIONS = {
    "start": ("frontend",),
    "tracking": ("frontend", "graph", "tracking"),
    "refinement": ("frontend", "refinement"),
}
"""Those that a stage depends on."""
DECIDES_NOTHING = frozenset({"refinement.workers", "tracking.image_cache_mb", "capture.truncate"})
"""No result depends on these; what ``capture.truncate`` leads to is compared as the capture."""


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run, and what became of the one it began with."""

    config: Config
    changed: tuple[str, ...] = ()
    """Keys that were added, removed or got another value since, without those that decide nothing."""
    removed: Mapping[str, Any] = field(default_factory=dict)
    """Recorded settings that this version does not have, or whose value it does not take, by key."""
    kept: Mapping[str, Any] = field(default_factory=dict)
    """Recorded settings that are not the defaults of this version, by key."""

    def log(self) -> None:
        """Tell what is not as the user may take it to be."""
        if self.removed:
            logger.warning("settings that this version does not take are left out: %s", _listed(self.removed))
        if self.kept:
            logger.info("goes on with the settings it began with; not the defaults: %s", _listed(self.kept))


def configure(out: Path, asked: Config | Mapping[str, Any] | None, *, resume: bool) -> RunConfig:
    """The configuration of a run that writes to ``out``; see ``resumed`` where one is to be gone on with.

    Raises ConfigError and, naming ``out``, ResultError.
    """
    if resume and is_reconstruction(out):
        manifest = read_manifest(out)
        try:
            return resumed(
                manifest["config"], [stage["name"] for stage in manifest["stages"]], given_settings(asked)
            )
        except ResultError as error:
            raise ResultError(f"{out}: {error}") from error
    return RunConfig(asked if isinstance(asked, Config) else config_from_dict(asked or {}))


def resumed(saved: Mapping[str, Any], finished: Collection[str], asked: Mapping[str, Any]) -> RunConfig:
    """``saved``, the configuration that a run began with, changed by what is ``asked`` for now.

    A setting that ``saved`` does not have takes its default; one that this version does not have is left
    out. Raises ResultError where ``asked`` differs from what a ``finished`` stage was made with, and where
    the whole is not valid.
    """
    if saved and not set(saved) & set(to_dict(Config())):
        raise ResultError("was not made by mvdyn reconstruct; choose another --out or --overwrite")
    recorded, defaults = flatten(saved), flatten(to_dict(Config()))
    taken, refused = sift(Config, saved)
    own = flatten(to_plain(taken))
    began = {**defaults, **own}
    wanted = {**began, **flatten(asked)}
    _refuse_other(began, wanted, finished)
    try:
        config = config_from_dict(nest(wanted))
    except ConfigError as error:
        raise ResultError(
            f"with the settings it began with, {error}; change one by --set, or start anew in another folder"
        ) from error
    changed = {key for key in {*recorded, *wanted} if key not in recorded or recorded[key] != wanted.get(key)}
    return RunConfig(
        config,
        tuple(sorted(changed - DECIDES_NOTHING)),
        {key: value for key, value in recorded.items() if _is_below(key, refused)},
        {key: value for key, value in own.items() if wanted[key] == value != defaults[key]},
    )


def resumed_prior(out: Path, asked: str | None, *, resume: bool) -> str | None:
    """Name of the depth prior that a run which writes to ``out`` has in the end; ``asked``: that it is given.

    A run that began with a prior goes on with it, and cannot without being given it again; once tracking is
    finished none is needed. Raises ResultError, naming ``out``.
    """
    if not (resume and is_reconstruction(out)):
        return asked
    manifest = read_manifest(out)
    began: str | None = manifest.get("depth_prior")
    if any(stage["name"] == "tracking" for stage in manifest["stages"]):
        if asked not in (None, began):
            raise ResultError(
                f"{out}: what is finished was made with {_prior(began)}, not {_prior(asked)}; leave that out"
                " to go on, or start anew in another folder"
            )
        return began
    if asked is None and began is not None:
        raise ResultError(
            f"{out}: began with {_prior(began)}; give it again to go on, or start anew in another folder"
        )
    return asked


def _prior(name: str | None) -> str:
    return "no depth prior" if name is None else f"the depth prior {name}"


def _refuse_other(began: Mapping[str, Any], wanted: Mapping[str, Any], finished: Collection[str]) -> None:
    fixed = {section for stage in finished for section in SECTIONS.get(stage, ())}
    other = [
        key
        for key, value in wanted.items()
        if value != began[key] and key.split(".")[0] in fixed and key not in DECIDES_NOTHING
    ]
    if other:
        what = ", ".join(f"{key}={_plain(began[key])}, not {_plain(wanted[key])}" for key in other)
        raise ResultError(
            f"what is finished was made with {what}; leave {'that' if len(other) == 1 else 'these'} out to go"
            " on, or start anew in another folder"
        )


def _is_below(key: str, refused: Collection[str]) -> bool:
    return any(key == one or key.startswith(f"{one}.") for one in refused)


def _listed(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={_plain(value)}" for key, value in settings.items())


def _plain(value: Any) -> str:
    return json.dumps(value)
