"""Configurations from mappings, files and Hydra, checked; and the sentences that refuse them."""

from __future__ import annotations

import os
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from yaml import YAMLError

from equirl.config.declare import ConfigError, check_values, flatten
from equirl.config.jobs import (
    DemonstrationsJob,
    EvaluateJob,
    ExportJob,
    FiguresJob,
    ReportJob,
    TrainJob,
    WatchJob,
)
from equirl.config.schema import Config

__all__ = [
    "explain",
    "load_config",
    "register",
    "save_config",
    "to_config",
    "write_atomically",
]

Job = TypeVar("Job")


def to_config(values: Any, schema: type[Job] = Config) -> Job:  # type: ignore[assignment]
    """Turns a mapping (or an OmegaConf node) into a validated configuration.

    Raises:
        ConfigError: An unknown key, a value of the wrong type or out of range; named.
    """
    if OmegaConf.is_config(values):
        # A plain mapping: what Hydra composed may hold keys that were forced upon it (`+key=1`).
        values = OmegaConf.to_container(values, resolve=True)
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), values)
        config = cast(Job, OmegaConf.to_object(merged))
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error, schema)) from None
    check_values(config)
    return config.validated() if hasattr(config, "validated") else config


def explain(error: Exception, schema: type) -> str:
    """Says in one sentence why a configuration cannot be composed.

    Args:
        error: OmegaConf's, or Hydra's about one of OmegaConf's.
        schema: The form of the keys.
    """
    reason = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(reason, OmegaConfBaseException):
        key = reason.full_key or "a key"
        if isinstance(reason, ConfigKeyError | ConfigAttributeError):
            return f"{key}: there is no such key{_suggestion(key, schema)}"
        if isinstance(reason, MissingMandatoryValue):
            return f"{key}= is missing"
        return f"{key}: {str(reason).splitlines()[0]}"
    options = getattr(error, "options", None)  # of Hydra's groups
    name = getattr(error, "missing_cfg_file", None)
    if options and name:
        group, _, choice = name.rpartition("/")
        return f"{group}={choice}: expected one of {', '.join(options)}"
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("See ", "full_key")))


def _suggestion(key: str, schema: type) -> str:
    known = flatten(schema())
    leaf = key.rpartition(".")[2]
    similar = [name for name in known if name.rpartition(".")[2] == leaf]
    similar = similar or get_close_matches(key, known, n=1) or get_close_matches(leaf, known, n=1)
    return f"; did you mean {' or '.join(similar)}?" if similar else ""


def save_config(config: Config, path: Path) -> None:
    """Writes the configuration as YAML."""
    write_atomically(path, OmegaConf.to_yaml(OmegaConf.structured(config)))


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file's text; an interruption leaves the old text or the new."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def load_config(path: Path) -> Config:
    """Reads a configuration that `save_config` wrote.

    Raises:
        ConfigError: The file is not one.
    """
    try:
        values = OmegaConf.load(path)
        if not OmegaConf.is_dict(values):
            raise ConfigError("expected keys and values")
        return to_config(values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise ConfigError(f"{path} not found: not the folder of a run") from None
    except (OSError, UnicodeError, YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not a readable configuration: {reason}") from None


def register() -> None:
    """Makes the schema known to Hydra, so that every key of a YAML file is validated."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    schemas = {"train": TrainJob, "watch": WatchJob, "demonstrations": DemonstrationsJob}
    for name, schema in schemas.items():
        node = OmegaConf.structured(schema)
        # The task and its expert check the names of their options themselves.
        OmegaConf.set_struct(node.env.options, False)
        if "demos" in node:
            OmegaConf.set_struct(node.demos.options, False)
        if "expert" in node:
            OmegaConf.set_struct(node.expert, False)
        store.store(name=f"{name}_schema", node=node)
    store.store(name="evaluate_schema", node=EvaluateJob)
    store.store(name="export_schema", node=ExportJob)
    store.store(name="report_schema", node=ReportJob)
    store.store(name="figures_schema", node=FiguresJob)
