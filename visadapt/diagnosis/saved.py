"""The effects that a diagnosis named, from the JSON file that `visadapt diagnose --json` wrote."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from visadapt.diagnosis.result import SCHEMA_VERSION, Cause, Estimate, named_effects
from visadapt.effects import EFFECTS, Effect

READABLE = (1, SCHEMA_VERSION)  # Versions of the file in which the causes have the same meaning


class DiagnosisFileError(ValueError):
    """A file of a diagnosis that gives no effects; the message is one line that says which and why."""


def load_effects(path: str | os.PathLike[str]) -> tuple[str, list[Effect]]:
    """The system that was diagnosed, by name, and the effects that were named, as `Diagnosis.effects` gives them.

    Raises:
        DiagnosisFileError: the file is missing or holds no diagnosis, the diagnosis named no effect, or one that is
            not known here or whose value the recording left open.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DiagnosisFileError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DiagnosisFileError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict) or content.get("schema") not in READABLE:
        raise DiagnosisFileError(
            f"{path}: no diagnosis of version 1 to {SCHEMA_VERSION}, such as `visadapt diagnose --json` writes"
        )
    try:
        causes = tuple(_cause(each) for each in content["causes"])
        for cause in causes:
            if cause.effect not in EFFECTS:
                raise ValueError(f"names {cause.effect}, which is not known here: give the file that defines it")
        return content["system"], named_effects(content["verdict"], causes)
    except (KeyError, TypeError, AttributeError) as error:
        raise DiagnosisFileError(f"{path}: not a whole diagnosis: {error}") from error
    except (ValueError, OverflowError) as error:
        raise DiagnosisFileError(f"{path}: {error}") from error


def _cause(content: Mapping[str, Any]) -> Cause:
    values = {
        name: Estimate(math.nan if one["value"] is None else float(one["value"]), one["unit"], (math.nan, math.nan))
        for name, one in content["parameters"].items()
    }
    return Cause(
        content["effect"], values, math.nan, math.nan, indistinguishable_from=tuple(content["indistinguishable_from"])
    )
