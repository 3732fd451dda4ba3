"""Options of a fit: the user's choices, and the tuning constants of its stages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, get_args

Method = Literal["equation_error", "output_error"]
Eccentricity = Literal["off", "on", "auto"]
# When incremental encoders were set to zero: before all recordings, or at the start of each.
EncoderReference = Literal["auto", "shared", "per_recording"]
# SciPy's robust losses without an upper limit, so that a distant start still converges.
Loss = Literal["linear", "soft_l1", "huber", "cauchy"]

CHOICES = {
    "method": get_args(Method),
    "eccentricity": get_args(Eccentricity),
    "encoder_reference": get_args(EncoderReference),
    "loss": get_args(Loss),
}


@dataclass(frozen=True)
class FitOptions:
    """Settings of a fit.

    The fields up to `fit_delay` are the user's, see `nfriction.fit`; the others are tuning
    constants with their reasons. For sliding joints lengths are in m. A `..._term` is the bound of
    a plant term and the standard deviation of its prior, both around the given plant.

    Raises:
        ValueError: if a choice does not exist, or two exclude each other.
    """

    method: Method = "output_error"
    # Short horizons converge from far away; long ones separate small friction from small drag [s].
    windows: Sequence[float] = (0.5, 2.0, 5.0)
    fit_plant: bool = True
    drag: bool | None = None
    eccentricity: Eccentricity = "off"
    encoder_reference: EncoderReference = "auto"
    max_steps: int = 30
    loss: Loss = "linear"
    fit_delay: bool = False

    # --- Data.
    # A recording that is faster over its first sample does not begin at rest [rad/s]; an encoder
    # that flickers by one count at 500 Hz seems to move at 0.2 rad/s.
    rest_speed: float = 0.3
    # An encoder that was just set to zero may flicker by a few counts [rad].
    zero_reading: float = 2e-3
    # Below this number of counts, quantisation is most of a joint's apparent motion.
    min_counts: int = 10
    # A spike is this many times as far from both neighbours as 99 % of samples (95 % of torques).
    spike_ratio: float = 20.0
    # Steps of one nominal rate differ by less than the first (the error of a quartz, with a
    # margin), those of deliberately different rates by more than the second.
    clock_error: tuple[float, float] = (1e-3, 0.05)
    # A mistake is reported if its correction halves the unexplained torque, a quarter of its power:
    # errors of a rig's data within their bounds change it by less.
    diagnosis_ratio: float = 2.0
    # Corrections that leave at most this many times as much as the best are not distinguished.
    diagnosis_tie: float = 1.25
    # Averaging time of torques, short compared with a swing [s], and number of samples used.
    diagnosis_block: float = 0.03
    diagnosis_samples: int = 8_000
    # Pieces of a recording, each left out in turn to find the scatter of a change of friction, and
    # the chance that constant friction is reported as changing.
    drift_pieces: int = 10
    drift_chance: float = 1e-3
    # Rise of the energy of a free motion over its largest kinetic energy; inertias at their bound
    # produce an apparent rise of 0.43.
    energy_rise: float = 0.5
    # Longest delay between torques and positions: several samples of a slow bus [s].
    largest_delay: float = 0.1
    # A sign function that needs more substeps is too steep for the sample time.
    max_substeps: int = 8

    # --- Equation error.
    # Smoothers are less accurate at the ends of a record, so this much of each is dropped [s].
    edge: float = 0.02
    # Share of the samples in the rarer direction from which a motion goes both ways.
    two_way: float = 0.05
    # Ridge relative to the data's information: negligible if the data are informative, and no
    # divergence if they are not (an offset and a sign that never changes).
    ridge: float = 1e-6
    # Share of the torque attributed to friction even if no law explains any of it.
    min_explained: float = 0.01

    # --- Terms of the plant.
    # Inertia and gravity terms of a bench are known to about 10 %; bounds as in the data cards.
    ratio_term: tuple[float, float] = (0.3, 0.1)
    # Lengths between joints come from a drawing or a ruler.
    length_term: tuple[float, float] = (0.1, 0.01)
    # The zero of an encoder is known to about a degree [rad].
    angle_term: tuple[float, float] = (0.1, 0.02)
    # A disc of 1 cm radius is centred on its shaft within a few hundredths of a millimetre [rad].
    eccentricity_term: tuple[float, float] = (0.02, 0.002)
    # Torque constants of two drives of the same type differ by up to 10 %.
    gain_term: tuple[float, float] = (0.3, 0.1)
    # A gear stage loses a few percent of the torque, a worm gear much more.
    loss_term: tuple[float, float] = (0.5, 0.05)
    # Bias of a current sensor over the largest torque; the prior is narrow because, with dry
    # friction, an offset and a wrong zero of an angle are nearly equivalent.
    offset_term: tuple[float, float] = (0.3, 0.01)
    # Of an axis: constant force over the largest, asymmetry over that at the largest speed.
    asymmetry_term: tuple[float, float] = (1.0, 0.1)
    # Drag of a slender bar is 0.5 rho c_d width, below 0.1 N s^2/m^3.
    drag_term: tuple[float, float] = (1.0, 0.05)
    # Buses and filters delay a torque by a few ms; the bound is `largest_delay` [s].
    delay_sd: float = 0.02
    # The length of the last link in the air is rarely measured: lower, upper, sd [link length].
    reach_term: tuple[float, float, float] = (-0.7, 1.0, 0.3)

    # --- Shooting problem.
    # Initial states from a smoother are far more accurate; their prior only prevents a window from
    # diverging [rad, rad/s].
    start_sd: tuple[float, float] = (0.01, 0.3)
    # At rest: about the quantisation error. A free initial velocity would absorb the friction
    # while the links break loose.
    rest_sd: tuple[float, float] = (1e-4, 1e-3)
    # Dry friction of a tenth of the gravity moment holds a link up to 0.1 rad off [rad].
    encoder_offset_sd: float = 0.05

    # --- Search.
    gradient_tolerance: float = 1e-6
    step_tolerance: float = 1e-8
    # Relative decrease that ends a search whose result only starts the next one.
    loose_tolerance: float = 1e-4
    # Searches with a robust loss: each takes its scale from the errors of the previous one, until
    # the scale changes by less than this fraction.
    most_scales: int = 5
    scale_tolerance: float = 0.05
    # Decrease of the cost that ends the last search: a tenth in log likelihood.
    loglik_tolerance: float = 0.1
    # Dry friction puts kinks into the cost along which steps creep; this number of consecutive
    # steps that gain no more than their tolerance ends a search.
    patience: int = 3
    # Divergent windows keep lowering the cost long after the shared parameters have converged:
    # stop when these move by less than this many sd, `patience` times in a row.
    settled_move: float = 0.05
    # Error of typical models before a fit has measured it [rad].
    first_noise: float = 1e-3
    # Smaller errors are round-off [rad].
    min_noise: float = 1e-9
    # Growth of the error from one horizon to the next that does not yet indicate chaos.
    max_growth: float = 10.0

    # Chance that noise alone makes a stage appear worse at a shorter horizon.
    loss_level: float = 0.01
    # Residuals below this multiple of the encoder's rounding leave no room for a better minimum.
    explained_ratio: float = 1.1
    # Search for the states of windows at given parameters: few unknowns with a close start.
    settling_steps: int = 30
    settling_tolerance: float = 1e-4

    # --- Hold-out of a network.
    # The law's error over that of a network has to be this: less could be measurement noise.
    network_gain: float = 1.1
    # Every `folds`-th window is held out at once, so that all sizes of the motion are represented.
    folds: int = 3
    # Chance that scatter counts as a gain on hold-out windows: one standard error, because priors
    # keep a network near its law, and the evidence has judged further inputs before.
    gain_chance: float = 0.16
    # The same where no evidence has judged before, and to overrule a gain on other hold-out data.
    input_chance: float = 0.05
    # Candidate priors, relative to the network's own.
    prior_shares: tuple[float, ...] = (1.0, 1 / 3)
    # Evidence updates of the priors of a network's groups; each search starts from the previous
    # one.
    evidence_updates: int = 3
    # Log ratio of evidences that is substantial: half the logarithm of 10 (H. Jeffreys, Theory of
    # Probability, 3rd ed. 1961, appendix B).
    evidence_gain: float = 0.5 * math.log(10.0)
    # The same for an input of friction: decisive, as the law depends on it wherever it is used.
    input_evidence: float = 2.0 * math.log(10.0)

    # --- Extrapolation prior of a network.
    # Grid cells along velocity and acceleration, cells around a visited one that count as
    # visited, and the spacing of the prior's points.
    cells: int = 60
    visited_radius: int = 5
    point_spacing: int = 5
    # Deviation expected at unvisited points, in units of the coefficients' scale.
    unvisited_sd: float = 0.2
    # Quantiles of the acceleration that bound a network's inputs; beyond them are outliers.
    acceleration_quantiles: tuple[float, float] = (0.001, 0.999)
    # Reference of a coefficient that is to remain zero, in units of its scale: above round-off, but
    # without effect on a simulation.
    zero_reference: float = 1e-6

    # --- Autocorrelation of the residuals.
    # Samples used per correlation time, and the maximum decimation: the residuals of a network have
    # shorter correlations than those of its constant law.
    samples_per_correlation: int = 8
    max_decimation: int = 20
    # Segments within which residuals are taken to be stationary, in correlation times, and their
    # smallest length in samples: shorter ones show too little of the correlation within them.
    stationary_times: float = 20
    min_stationary: int = 500
    # Lags of the spectral density, in correlation times, and their smallest share of a segment.
    lag_times: float = 20
    min_lag_share: float = 0.1
    # Share of the motion's power within its bandwidth, and the harmonics of it that friction and
    # inertia add.
    band_power: float = 0.999
    band_harmonics: int = 2

    # --- Uncertainty.
    # A direction is unidentifiable if its information is below that of its parameters alone by
    # the square of this factor.
    null_ratio: float = 1e3
    # An estimate whose interval includes zero is unidentifiable if conditioning on the others
    # shrinks its sd by this factor; otherwise it is just small.
    conditional_ratio: float = 30.0
    # Entries below this share of a direction's largest are not named.
    named_share: float = 0.3
    # Residuals above this many times the measurement noise are model error.
    model_error_ratio: float = 3.0

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(f"`{name}` must be one of {allowed}, got {value!r}.")
        object.__setattr__(self, "windows", checked_lengths("windows", self.windows))
        # Any text would be true.
        for name in ("fit_plant", "drag", "fit_delay"):
            value = getattr(self, name)
            if value not in ((True, False, None) if name == "drag" else (True, False)):
                raise ValueError(f"`{name}` must be True or False, got {value!r}.")
        if not isinstance(self.max_steps, Integral) or self.max_steps < 0:
            raise ValueError(
                f"`max_steps` must be a whole number of at least 0, got {self.max_steps!r}."
            )
        if not self.fit_plant and (self.drag or self.eccentricity == "on"):
            raise ValueError(
                '`drag=True` and `eccentricity="on"` fit terms of the plant, so they need '
                "`fit_plant=True`, got False."
            )
        if self.method == "equation_error":
            if self.encoder_reference == "per_recording":
                raise ValueError(
                    '`encoder_reference="per_recording"` needs `method="output_error"`.'
                )
            if self.fit_delay:
                raise ValueError('`fit_delay=True` needs `method="output_error"`.')


def checked_lengths(name: str, given: object, least: int = 1) -> tuple[float, ...]:
    """Lengths of windows [s], finite and positive, at least `least` of them."""
    try:
        # Texts are not lengths, although Python converts some to numbers.
        lengths = tuple(float(1.0 * w) for w in given)  # type: ignore[attr-defined]
    except TypeError:
        lengths = (math.nan,)
    if len(lengths) < least or not all(0 < w < math.inf for w in lengths):
        raise ValueError(
            f"`{name}` must be positive lengths [s] such as (0.5, 2.0), got {given!r}; write a "
            f"single one as (2.0,)."
        )
    return lengths


DEFAULTS = FitOptions()
