"""Do jaxkane and MuJoCo's `sysid` agree, how often do their intervals contain the truth, and how long do they take?

An arm of two links hangs at rest. A motor at the shoulder moves it by a known torque, held for 10 ms. Eight records of
2 s contain the angles of both joints at 100 Hz, with errors of 2 mrad. Both programs read the same MJCF model, the same
records and the same initial guess, which is 30 % above the true values. Both know the initial state.

    mass.fore, center.fore.z           mass [kg] and height of the mass centre [m] of the second link
    damping.shoulder, damping.elbow    viscous friction of the joints [N m s/rad]

    jaxkane            `jaxkane.fit.fit`: exact derivatives; the scatter between the records gives the intervals
    sysid              `mujoco.sysid.optimize`: finite differences, formal intervals by `calculate_intervals`
    sysid, sigma       the same, with residuals divided by the standard deviation of the errors. By default, `sysid`
                       divides them by the norm of each signal of each record

jaxkane simulates the records with a tolerance of 1e-10. MuJoCo uses RK4 with steps of 10 ms. Its integration error
changes no estimate by more than a tenth of a standard error, which is asserted. The measured signals are `qpos`,
because MuJoCo evaluates sensors before each step: `sysid` compares joint sensors with data that are one step later.

The simulations are repeated with errors that are correlated in time: 0.9 between neighbouring samples.

Run:      python -m benchmarks.sysid [--sets 5]
Needs:    pip install "mujoco[sysid]>=4.0"
Appears:  estimates and 95 % intervals for one data set; CPU seconds of two fits; the coverage of the intervals, their
          widths and the scatter of the estimates for many data sets.
Takes:    half a minute; half an hour with `--sets 300`, as in the documentation.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

RECORDS, SAMPLES, INTERVAL, SIGMA = 8, 201, 0.01, 2e-3  # [s], [rad]
TRUTH = {"mass.fore": 0.6, "center.fore.z": -0.12, "damping.shoulder": 0.05, "damping.elbow": 0.02}
TRUE, GUESS = np.array([*TRUTH.values()]), {name: 1.3 * value for name, value in TRUTH.items()}
CORRELATIONS = {"independent errors": 0.0, "correlated errors": 0.9}
JOINTS = ("shoulder", "elbow")
ARM = f"""<mujoco model="arm"><option timestep="{INTERVAL}" integrator="RK4"><flag contact="disable"/></option>
<worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="{TRUTH["damping.shoulder"]}"/>
  <inertial pos="0 0 -0.15" mass="1" diaginertia="0.01 0.01 0.001"/>
  <body name="fore" pos="0 0 -0.3">
    <joint name="elbow" axis="0 1 0" damping="{TRUTH["damping.elbow"]}"/>
    <inertial pos="0 0 {TRUTH["center.fore.z"]}" mass="{TRUTH["mass.fore"]}" diaginertia="0.004 0.004 0.0005"/>
  </body></body></worldbody>
<actuator><motor name="motor" joint="shoulder"/></actuator>
<sensor><jointpos name="first" joint="shoulder"/><jointpos name="second" joint="elbow"/></sensor></mujoco>"""


class Answer(NamedTuple):
    estimates: np.ndarray  # (p,)
    intervals: np.ndarray  # (p, 2)


def experiment() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), torques (records, n) and true angles (records, n, 2)."""
    arm, t, rng = jk.convert.from_mjcf(ARM), INTERVAL * np.arange(SAMPLES), np.random.default_rng(0)
    phases = rng.uniform(0.0, 2.0 * np.pi, (RECORDS, 1, 4))
    torques = 0.8 * np.sin(2.0 * np.pi * np.array([0.4, 0.9, 1.5, 2.2]) * t[:, None] + phases).sum(axis=-1)

    def angles(torque):
        motor = jk.Samples(jnp.asarray(t), torque, zero_order_hold=True)
        return jk.simulate(arm, jk.State({}, {}), jnp.asarray(t), {"motor": motor}, rtol=1e-10, atol=1e-10).q

    return t, torques, np.asarray(jax.jit(jax.vmap(angles))(torques))


def errors(shape: tuple[int, ...], correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Measurement errors [rad]: a stationary autoregression along the second axis."""
    found = rng.normal(0.0, SIGMA, shape)
    for k in range(1, shape[1]):
        found[:, k] = correlation * found[:, k - 1] + np.sqrt(1.0 - correlation**2) * found[:, k]
    return found


def by_jaxkane(t: np.ndarray, torques: np.ndarray) -> Callable[[np.ndarray], Answer]:
    arm = jk.convert.from_mjcf(ARM).replace(GUESS)
    rest = dict.fromkeys((*arm.coordinates, *arm.speeds), 0.0)

    def run(measured):
        trials = [
            jk.fit.Trial(t, dict(zip(JOINTS, y.T)), {"motor": torque}, sigma=SIGMA, initial=rest)
            for y, torque in zip(measured, torques, strict=True)
        ]
        found = jk.fit.fit(arm, trials, tuple(TRUTH), zero_order_hold=("motor",))
        intervals = found.intervals()
        return Answer(
            np.array([found.estimates[name] for name in TRUTH]), np.array([intervals[name] for name in TRUTH])
        )

    return run


def by_sysid(t: np.ndarray, torques: np.ndarray, known_sigma: bool = False) -> Callable[[np.ndarray], Answer]:
    import mujoco
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(ARM)
    model = spec.compile()
    rest = sysid.create_initial_state(model, np.zeros(2), np.zeros(2))
    setters = {
        "mass.fore": lambda spec, new: setattr(spec.body("fore"), "mass", new.value[0]),
        "center.fore.z": lambda spec, new: spec.body("fore").ipos.__setitem__(2, new.value[0]),
        "damping.shoulder": lambda spec, new: spec.joint("shoulder").damping.__setitem__(0, new.value[0]),
        "damping.elbow": lambda spec, new: spec.joint("elbow").damping.__setitem__(0, new.value[0]),
    }
    signals = [(joint, sysid.SignalType.MjStateQPos) for joint in JOINTS]
    control = [sysid.TimeSeries.from_control_names(t, torque[:, None], model) for torque in torques]
    names = [str(k) for k in range(len(torques))]

    def weighted(parameters, sensors, measured, model, return_all, state):
        """Residuals in standard deviations; the first sample is the initial state."""
        measured = sysid.TimeSeries(measured.times[1:], measured.data[1:], measured.signal_mapping)
        simulated = sysid.TimeSeries(state[:, 0], state[:, 1:3], measured.signal_mapping)
        return (simulated.data - measured.data) / SIGMA, simulated, measured

    def run(measured):
        parameters = sysid.ParameterDict()
        for name, value in GUESS.items():
            low, high = sorted((0.1 * value, 10.0 * value))
            parameters.add(sysid.Parameter(name, value, low, high, modifier=setters[name]))
        data = [sysid.TimeSeries.from_names(t, y, model, signals) for y in measured]
        sequences = sysid.ModelSequences("arm", spec, names, [rest] * len(names), control, data)
        options: dict[str, Any] = {"modify_residual": weighted} if known_sigma else {}
        residual = sysid.build_residual_fn(models_sequences=[sequences], **options)
        # Without x_scale="jac", a fit took four times as long to the same minimum.
        with contextlib.redirect_stdout(io.StringIO()):
            parameters, found = sysid.optimize(parameters, residual, verbose=False, x_scale="jac")
        half = sysid.calculate_intervals(residual(found.x, parameters)[0], found.jac)[1]
        return Answer(found.x, np.stack([found.x - half, found.x + half], axis=1))

    return run


def timed(run: Callable[[np.ndarray], Answer], measured: np.ndarray) -> tuple[Answer, float]:
    """The answer, and CPU seconds of all threads."""
    started = time.process_time()
    answer = run(measured)
    return answer, time.process_time() - started


def one_set(programs: dict[str, Callable[[np.ndarray], Answer]], measured: np.ndarray) -> None:
    """Print estimates, intervals and CPU seconds for one data set."""
    answers, seconds = {}, {}
    for title, run in programs.items():
        (_, first), (answers[title], second) = timed(run, measured), timed(run, measured)
        seconds[title] = first, second
    print(f"{'':<18}{'truth':>8}" + "".join(f"{title:>37}" for title in programs))
    for k, name in enumerate(TRUTH):
        row = f"{name:<18}{TRUE[k]:>8g}"
        for answer in answers.values():
            low, high = answer.intervals[k]
            row += f"{answer.estimates[k]:>13.6f}{f'{low:.6f} to {high:.6f}':>24}"
        print(row)
    print("\nCPU seconds       first fit    second fit")
    for title, (first, second) in seconds.items():
        print(f"{title:<14}{first:>13.2f}{second:>14.2f}")
    # The same cost: the estimates may differ by MuJoCo's integration error and by the tolerances of the optimizers.
    ours, theirs = answers["jaxkane"], answers["sysid, sigma"]
    standard_errors = np.diff(theirs.intervals)[:, 0] / 3.92
    assert np.all(np.abs(ours.estimates - theirs.estimates) < 0.1 * standard_errors)


def coverage(programs: dict[str, Callable[[np.ndarray], Answer]], angles: np.ndarray, sets: int) -> None:
    """Print the coverage of the intervals. Its standard error counts each set once, because the intervals of a set are
    correlated."""
    print(
        f"\n{sets} data sets: coverage of the 95 % intervals (mean of all, of each parameter); scatter of the estimates"
    )
    print("relative to jaxkane's; width of the intervals relative to that scatter (ideal: 1)")
    for title, correlation in CORRELATIONS.items():
        answers: dict[str, list[Answer]] = {program: [] for program in programs}
        for k in range(sets):
            measured = angles + errors(angles.shape, correlation, np.random.default_rng(k))
            for program, run in programs.items():
                answers[program].append(run(measured))
        reference = np.std([answer.estimates for answer in answers["jaxkane"]], axis=0)
        for program, found in answers.items():
            intervals = np.array([answer.intervals for answer in found])
            hits = (intervals[..., 0] <= TRUE) & (TRUE <= intervals[..., 1])  # (sets, p)
            scatter = np.std([answer.estimates for answer in found], axis=0)
            width = np.median(np.diff(intervals)[..., 0], axis=0) / (3.92 * scatter)
            share = (sets * hits.mean() + 2) / (sets + 4)  # Agresti and Coull (1998): not zero at 100 %
            uncertainty = 100 * np.sqrt(share * (1 - share) / sets)
            each = " ".join(f"{100 * one:.0f}" for one in hits.mean(axis=0))
            print(
                f"{title:<20}{program:<14}{100 * hits.mean():>6.1f} ± {uncertainty:.1f} %   {each:<18}"
                f"{np.mean(scatter / reference):>6.2f}{np.mean(width):>8.2f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=5, help="simulated data sets for each kind of error (default: 5)")
    given = parser.parse_args()
    try:
        from mujoco.sysid import optimize  # noqa: F401 (`import mujoco.sysid` succeeds without its dependencies)
    except ImportError:
        sys.exit('MuJoCo\'s sysid cannot be imported: pip install "mujoco[sysid]>=4.0"')
    jk.configure(verbose=False, cache=False)
    t, torques, angles = experiment()
    programs = {
        "jaxkane": by_jaxkane(t, torques),
        "sysid, sigma": by_sysid(t, torques, known_sigma=True),
        "sysid": by_sysid(t, torques),
    }
    one_set(programs, angles + errors(angles.shape, 0.0, np.random.default_rng(0)))
    coverage(programs, angles, given.sets)


if __name__ == "__main__":
    main()
