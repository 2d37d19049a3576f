"""Poisson's equation on irregular holes of an image: depth completion and seamless blending stand on it.

`equations.py` says what is solved – the sign of the guidance stands in its `_solve`, under SIGN OF THE GUIDANCE – and
`multigrid.py` solves it.
"""

from .equations import PoissonSettings, PoissonSolution, solve_poisson

__all__ = ["PoissonSettings", "PoissonSolution", "solve_poisson"]
