"""Solvers: least squares with bounds, Bayesian regularisation, pattern search."""

from nfriction.solve.evidence import bayesian_regularisation
from nfriction.solve.evidence_result import EvidenceResult, EvidenceState
from nfriction.solve.jacobian import NormalEquations, normal_equations, per_sample_jacobian
from nfriction.solve.least_squares import LeastSquaresResult, Quadratic, Step, from_residuals
from nfriction.solve.levenberg import LevenbergMarquardt
from nfriction.solve.marginal import maximise_evidence
from nfriction.solve.pattern import PatternResult, PatternSearch, PatternState

__all__ = [
    "EvidenceResult",
    "EvidenceState",
    "LeastSquaresResult",
    "LevenbergMarquardt",
    "NormalEquations",
    "PatternResult",
    "PatternSearch",
    "PatternState",
    "Quadratic",
    "Step",
    "bayesian_regularisation",
    "from_residuals",
    "maximise_evidence",
    "normal_equations",
    "per_sample_jacobian",
]
