"""States to frames: drawn (OpenCV) and learnt (networks). Independent of visadapt."""

from renderers.drawn import Camera, DrawnCartPole
from renderers.learnt import LayeredRenderer, MLPRenderer
from renderers.weights import RendererError, load_renderer, save_renderer

__all__ = [
    "Camera",
    "DrawnCartPole",
    "LayeredRenderer",
    "MLPRenderer",
    "RendererError",
    "load_renderer",
    "save_renderer",
]
