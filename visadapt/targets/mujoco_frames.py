"""What MuJoCo's rendering needs from whoever uses many environments of gymnasium in one process, without a display."""

from __future__ import annotations

import ctypes.util
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any

from visadapt.targets.base import TargetError

BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}
"""MUJOCO_GL and the shared library it needs, the faster first."""

ADVICE = (
    "install EGL (Debian: apt-get install libegl1 libgl1; then MUJOCO_GL=egl) "
    "or OSMesa (apt-get install libosmesa6; then MUJOCO_GL=osmesa)"
)


def choose_backend() -> None:
    """Set MUJOCO_GL where it is unset and there is no display; call it before mujoco is first imported."""
    displayed = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if "MUJOCO_GL" in os.environ or displayed or not sys.platform.startswith("linux"):
        return
    found = [backend for backend, library in BACKENDS.items() if ctypes.util.find_library(library)]
    os.environ["MUJOCO_GL"] = found[0] if found else "egl"


def cannot_render(name: str, error: BaseException) -> TargetError:
    """The one line that says that no frame can be drawn and what to do about it."""
    backend = os.environ.get("MUJOCO_GL", "unset")
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    return TargetError(f"{name}: cannot render off-screen (MUJOCO_GL is {backend}: {reason}); {ADVICE}")


def is_mujoco(env: Any) -> bool:
    """Whether gymnasium's own MuJoCo renderer draws the environment."""
    return hasattr(getattr(env.unwrapped, "mujoco_renderer", None), "_get_viewer")


def is_blamed(error: BaseException) -> bool:
    """Whether mujoco failed to be imported: what it does, in many ways, where MUJOCO_GL names what is not there."""
    return any(
        frame.filename.replace(os.sep, "/").endswith("/mujoco/__init__.py")
        for frame in traceback.extract_tb(error.__traceback__)
    )


def probe(name: str) -> None:
    """Make and free a GL context; raises TargetError where there is none.

    gymnasium's viewer, when it fails, prints a traceback of its destructor besides; so it is not the first to try.
    """
    try:
        import mujoco

        mujoco.GLContext(8, 8).free()
    except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, RuntimeError, ...
        raise cannot_render(name, error) from error


def share_viewer(envs: Sequence[Any]) -> None:
    """Let all environments draw with the viewer of the first: each viewer of its own takes 90 MB and 0.2 s."""
    for env in envs[1:]:
        env.unwrapped.mujoco_renderer = envs[0].unwrapped.mujoco_renderer


def aim_viewer(env: Any) -> None:
    """Point the shared viewer at this environment.

    gymnasium makes a viewer's GL context current only once, so with two of them in a process (source and target,
    say) frames come from the wrong one, or from none, unless it is made current before every frame.
    """
    viewer = env.unwrapped.mujoco_renderer._get_viewer("rgb_array")
    viewer.model, viewer.data = env.unwrapped.model, env.unwrapped.data
    viewer.make_context_current()


def close_all(envs: Sequence[Any]) -> None:
    """Close environments that share a viewer, which only the first may free, and only while its context is current."""
    for env in envs[1:]:
        env.unwrapped.mujoco_renderer = None
    renderer = envs[0].unwrapped.mujoco_renderer
    if renderer is not None and renderer.viewer is not None:
        renderer.viewer.make_context_current()
    for env in envs:
        env.close()
