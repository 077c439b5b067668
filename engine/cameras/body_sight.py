"""Lines of sight to joint centres, where an estimator knows better than the picture's points.

A network that finds points in a picture puts a hip where it has learnt hips to be; a lifting
network, which saw all those points over time, says where the joint centres of such a body are. Its
joints are put where they look most like the picture, and are then seen from the camera again.
"""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array
from engine.optics import place_on_rays

__all__ = ["see_body_again"]

DOUBT = 0.1
"""Weight of a point without confidence, relative to a sure one."""


def see_body_again(body: Array, sigma: Array, rays: Array, confidence: Array) -> Array:
    """Return lines of sight in which the joints an estimator is sure of replace the points.

    Parameters
    ----------
    body
        Shape (T, K, 3), m, camera axes.
    sigma
        Shape (T, K), m, the standard error the estimator states; NaN where it states none, and
        there the points of the picture stay.
    rays
        Shape (T, K, 3), lines of sight with unit depth; NaN where not seen.
    confidence
        Shape (T, K), 0 to 1; NaN counts as none.

    Returns
    -------
    Array
        Shape (T, K, 3), unit depth. A point that is missing in the picture stays missing.
    """
    stated = np.isfinite(sigma) & np.isfinite(body).all(axis=2)
    if not stated.any():
        return rays
    weight = np.where(stated, DOUBT + (1 - DOUBT) * np.nan_to_num(confidence), 0.0)
    place = place_on_rays(body, rays, weight)
    points = body + place[:, None]
    again = points / points[..., 2:]
    use = stated & np.isfinite(again).all(axis=2) & np.isfinite(rays).all(axis=2)
    return np.where(use[..., None], again, rays)
