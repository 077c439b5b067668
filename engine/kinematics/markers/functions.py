"""Functions of one coordinate that joints of OpenSim models are made of, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from xml.etree.ElementTree import Element

import numpy as np
from scipy.interpolate import PPoly

from engine.datatypes import Array
from engine.errors import DataError

__all__ = ["JointFunction", "constant", "linear", "parse_function"]

JointFunction = Callable[[Array], tuple[Array, Array]]
"""Takes a coordinate (T,) and returns value and derivative, (T,) each."""


def constant(value: float) -> JointFunction:
    """Return a function of fixed value."""
    return lambda q: (np.full_like(q, value), np.zeros_like(q))


def linear(slope: float = 1.0, intercept: float = 0.0) -> JointFunction:
    """Return ``slope * q + intercept``."""
    return lambda q: (slope * q + intercept, np.full_like(q, slope))


def scaled(function: JointFunction, factor: float) -> JointFunction:
    """Return a multiple of a function."""

    def evaluate(q: Array) -> tuple[Array, Array]:
        value, slope = function(q)
        return factor * value, factor * slope

    return evaluate


def piecewise(pieces: PPoly) -> JointFunction:
    """Return a piecewise polynomial that goes on straight beyond its ends, as OpenSim's do."""
    low, high = float(pieces.x[0]), float(pieces.x[-1])
    slopes = pieces.derivative()

    def evaluate(q: Array) -> tuple[Array, Array]:
        inside = np.clip(q, low, high)
        slope = np.asarray(slopes(inside), dtype=np.float64)
        return np.asarray(pieces(inside) + slope * (q - inside), dtype=np.float64), slope

    return evaluate


def simm_spline(x: Array, y: Array) -> JointFunction:
    """Return the cubic spline of SIMM and OpenSim (`SimmSpline`).

    At either end its third derivative is that of the cubic through the four outermost points [1]_.

    References
    ----------
    .. [1] Forsythe, Malcolm & Moler (1977), Computer Methods for Mathematical Computations, ch. 4.
    """
    n, h = x.size, np.diff(x)
    slope = np.diff(y) / h
    if n < 3:
        return piecewise(PPoly(np.stack([slope, y[:-1]]), x))
    matrix, right = np.zeros((n, n)), np.zeros(n)
    for i in range(1, n - 1):
        matrix[i, i - 1 : i + 2] = h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]
        right[i] = slope[i] - slope[i - 1]
    matrix[0, :2] = -h[0], h[0]
    matrix[-1, -2:] = h[-1], -h[-1]
    if n > 3:
        second = np.diff(slope) / (x[2:] - x[:-2])
        third = np.diff(second) / (x[3:] - x[:-3])
        right[0], right[-1] = h[0] ** 2 * third[0], -(h[-1] ** 2) * third[-1]
    sigma = np.linalg.solve(matrix, right)  # a sixth of the second derivative
    pieces = np.stack(
        [
            np.diff(sigma) / h,
            3.0 * sigma[:-1],
            slope - h * (sigma[1:] + 2.0 * sigma[:-1]),
            y[:-1],
        ]
    )
    return piecewise(PPoly(pieces, x))


def _numbers(element: Element, tag: str) -> Array:
    return np.array([float(word) for word in (element.findtext(tag) or "").split()])


def parse_function(element: Element) -> JointFunction:
    """Turn the XML of a function into one that can be evaluated.

    Raises
    ------
    DataError
        If the kind of function is not supported.
    """
    kind = element.tag
    if kind == "Constant":
        return constant(float(element.findtext("value") or 0.0))
    if kind == "LinearFunction":
        slope, intercept = _numbers(element, "coefficients")
        return linear(float(slope), float(intercept))
    if kind == "SimmSpline":
        return simm_spline(_numbers(element, "x"), _numbers(element, "y"))
    if kind == "PiecewiseLinearFunction":
        x, y = _numbers(element, "x"), _numbers(element, "y")
        return piecewise(PPoly(np.stack([np.diff(y) / np.diff(x), y[:-1]]), x))
    if kind == "PolynomialFunction":
        return _polynomial(_numbers(element, "coefficients"))
    if kind == "MultiplierFunction":
        inner = element.find("function")
        if inner is not None and len(inner):
            return scaled(parse_function(inner[0]), float(element.findtext("scale") or 1.0))
    raise DataError(
        f"A joint of the model uses a {kind}, which is not supported; use a model whose joints are "
        "linear, polynomial or spline functions."
    )


def _polynomial(coefficients: Array) -> JointFunction:
    slopes = np.polyder(coefficients)

    def evaluate(q: Array) -> tuple[Array, Array]:
        value = np.asarray(np.polyval(coefficients, q), dtype=np.float64)
        return value, np.asarray(np.polyval(slopes, q) * np.ones_like(q), dtype=np.float64)

    return evaluate
