"""MuJoCo rendering without a display, for many gymnasium environments in one process."""

from __future__ import annotations

import ctypes.util
import os
import sys
from collections.abc import Sequence
from typing import Any

from visadapt.targets.base import TargetError


def choose_backend() -> None:
    """Set MUJOCO_GL if it is unset and there is no display; must be called before mujoco is first imported."""
    displayed = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if "MUJOCO_GL" in os.environ or displayed or not sys.platform.startswith("linux"):
        return
    # EGL is the faster.
    only_osmesa = ctypes.util.find_library("OSMesa") and not ctypes.util.find_library("EGL")
    os.environ["MUJOCO_GL"] = "osmesa" if only_osmesa else "egl"


def cannot_render(name: str, error: BaseException) -> TargetError:
    """The error that no frame can be drawn, in one line with what to install."""
    backend = os.environ.get("MUJOCO_GL", "unset")
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    return TargetError(
        f"{name}: cannot render off-screen (MUJOCO_GL is {backend}: {reason}); install EGL (Debian: apt-get install "
        "libegl1 libgl1; then MUJOCO_GL=egl) or OSMesa (apt-get install libosmesa6; then MUJOCO_GL=osmesa)"
    )


def is_mujoco(env: Any) -> bool:
    """Whether the environment is drawn by gymnasium's own MuJoCo renderer."""
    return hasattr(getattr(env.unwrapped, "mujoco_renderer", None), "_get_viewer")


def check_rendering(name: str) -> None:
    """Create and free a GL context; raises TargetError if that fails.

    Done before gymnasium's viewer is created, which on failure also prints a traceback from its destructor.
    """
    try:
        import mujoco

        mujoco.GLContext(8, 8).free()
    except Exception as error:  # depending on the backend an ImportError, AttributeError, RuntimeError, ...
        raise cannot_render(name, error) from error


def share_viewer(envs: Sequence[Any]) -> None:
    """Let all environments draw with the viewer of the first, since each viewer takes 90 MB and 0.2 s to create."""
    for env in envs[1:]:
        env.unwrapped.mujoco_renderer = envs[0].unwrapped.mujoco_renderer


def aim_viewer(env: Any) -> None:
    """Point the shared viewer at this environment, in the state that it shows.

    MuJoCo's Euler integrator moves the coordinates last in a step, so that the bodies, the camera and the light, which
    follow from them, would be drawn where they were a step of the physics earlier.

    gymnasium makes a viewer's GL context current only once. With two viewers in a process frames would come from the
    wrong one, or from none, unless the context is made current before every frame.
    """
    import mujoco

    viewer = env.unwrapped.mujoco_renderer._get_viewer("rgb_array")
    viewer.model, viewer.data = env.unwrapped.model, env.unwrapped.data
    viewer.make_context_current()
    mujoco.mj_kinematics(viewer.model, viewer.data)
    mujoco.mj_camlight(viewer.model, viewer.data)


def close_all(envs: Sequence[Any]) -> None:
    """Close environments that share a viewer; only the first may free it, and only while its context is current."""
    for env in envs[1:]:
        env.unwrapped.mujoco_renderer = None
    renderer = envs[0].unwrapped.mujoco_renderer
    if renderer is not None and renderer.viewer is not None:
        renderer.viewer.make_context_current()
    for env in envs:
        env.close()
