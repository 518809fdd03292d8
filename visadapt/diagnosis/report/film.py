"""A film in the report: its frames beside the predicted ones, and where nothing explains its pixels."""

from __future__ import annotations

import base64
import json
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visadapt.diagnosis.result import FilmFrames


def shown(film: FilmFrames) -> dict[str, Any]:
    """What the page needs: pictures as data URLs, of all frames one below the other, and the words for each frame."""
    height, width = film.filmed.shape[1:]
    worst = float(film.left.max())
    heat = cv2.applyColorMap(np.asarray(255 * film.left / max(worst, 1e-9), np.uint8), cv2.COLORMAP_INFERNO)
    captions = [f"episode {k}, {t:.2f} s" for k, t in zip(film.episode, film.time, strict=True)]
    return {
        "width": width,
        "height": height,
        "filmed": _url(film.filmed.reshape(-1, width)),
        "predicted": _url(film.predicted.reshape(-1, width)),
        "heat": _url(heat),
        "worst": worst,
        "ahead": film.ahead,
        "captions": captions,
        "script": json.dumps(captions),
    }


def _url(picture: NDArray[Any]) -> str:
    done, content = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done
    return f"data:image/png;base64,{base64.b64encode(content.tobytes()).decode()}"
