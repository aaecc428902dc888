"""Which parameters does a nonlinear bicycle have? Estimation from noisy data by gradient descent.

The benchmark bicycle is simulated at 4.4, 5.2 and 6 m/s. Known torques excite steer and roll. Roll, steer and their
rates are measured with noise at 100 Hz. The initial guesses of four parameters are wrong by 20 %. With these guesses
the bicycle would fall over, so the trials are cut into windows of 2.5 s with unknown initial states.

    variable    meaning                                                              unit
    IBxx        roll inertia of the rear frame with its rider                        kg m^2
    zB          height of their mass centre, downwards positive                      m
    c           trail                                                                m
    IFyy        spin inertia of the front wheel                                      kg m^2
    roll, steer, roll_rate, steer_rate    measured                                   rad, rad/s
    steer_torque, roll_torque             known                                      N m

Run:      python examples/fit_bicycle.py [--out FOLDER]
Appears:  a table (initial guess, estimate, standard error, true value) and fit_bicycle.png: measurements and fits, the
          cost of each step, and the error of each estimate with its uncertainty.
Takes:    under a minute, half of it compilation.

For measured data, see `identify_measured_bicycle.py`.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Trial, fit_bicycle

jax.config.update("jax_enable_x64", True)

NOISE = {"roll": 0.005, "steer": 0.005, "roll_rate": 0.03, "steer_rate": 0.05}  # [rad, rad/s]
OFF = {"IBxx": 1.2, "zB": 0.8, "c": 1.2, "IFyy": 0.8}  # the initial guess, as a part of the truth
LABELS = {
    "roll": "roll [deg]",
    "steer": "steer [deg]",
    "roll_rate": "roll rate [deg/s]",
    "steer_rate": "steer rate [deg/s]",
}
DOTS, LINE, TRUE = "#e8a33d", "#14507a", "#c8354a"


def simulated_rides(bicycle):
    """Rides of a known bicycle, with noise."""
    rng = np.random.default_rng(7)
    t = np.linspace(0.0, 5.0, 501)
    rides = []
    for speed in (4.4, 5.2, 6.0):
        inputs = {
            "steer_torque": waves(rng, t, 2.0, (0.4, 0.9, 1.7, 2.9)),
            "roll_torque": waves(rng, t, 20.0, (0.3, 0.7, 1.3)),
        }
        start = jk.assemble(bicycle, {"roll": 0.02}, {"rear_wheel_rate": -speed / bicycle.rR, "roll_rate": 0.1})
        ride = jk.simulate(bicycle, start, t, inputs)
        measured = {name: np.asarray(ride[name]) + rng.normal(0.0, s, t.size) for name, s in NOISE.items()}
        rides.append(Trial(t, measured, inputs, sigma=NOISE, initial={"speed": speed}, name=f"{speed:g} m/s"))
    return rides


def waves(rng, t, size, frequencies):
    """A sum of sines [N m] of these frequencies [Hz]."""
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    return (
        size
        / len(frequencies) ** 0.5
        * sum(np.sin(2.0 * np.pi * f * t + phase) for f, phase in zip(frequencies, phases, strict=True))
    )


def fit_simulated():
    truth = WhippleBicycle.benchmark()
    rides = simulated_rides(truth)
    initial_guess = truth
    for name, factor in OFF.items():
        initial_guess = eqx.tree_at(lambda b, name=name: getattr(b, name), initial_guess, factor * getattr(truth, name))
    print("Three rides, four parameters that start 20 % off. Compiling takes a while the first time.")
    result = fit_bicycle(rides, initial_guess, tuple(OFF), window=2.5, steps=60, progress=True)
    print(f"\n{result}\n\n{result.table(truth)}")
    known = {name: float(getattr(truth, name)) for name in OFF}
    assert result.ok, result.message
    for name, value in known.items():  # within 2 %, and three standard errors
        assert abs(result.estimates[name] - value) < min(0.02 * abs(value), 3.0 * result.standard_errors[name]), name
    return result, known


def draw(result, truth, path):
    """Measurements and fits, the cost, and the parameters."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 10})
    figure = plt.figure(figsize=(12, 8), layout="constrained")
    rows = figure.subfigures(2, 1, height_ratios=(2.1, 1))
    problem, fitted = result.problem, result.fitted
    chosen = np.unique(np.linspace(0, len(problem.trials) - 1, 3).astype(int))
    axes = rows[0].subplots(4, len(chosen), sharex="col", sharey="row", squeeze=False)
    for column, k in zip(axes.T, chosen, strict=True):
        trial, name = problem.trials[k], result.trial_names[k]
        for ax, channel in zip(column, problem.channels, strict=True):
            ax.plot(
                trial.t, np.degrees(trial.measured[channel]), ".", color=DOTS, markersize=3, alpha=0.6, label="measured"
            )
            ax.plot(trial.t, np.degrees(fitted[name][channel]), color=LINE, linewidth=1.0, label="fitted")
            ax.grid(alpha=0.25)
        column[0].set_title(name, loc="right")
        column[-1].set_xlabel("time [s]")
    for ax, channel in zip(axes[:, 0], problem.channels, strict=True):
        ax.set_ylabel(LABELS[channel])
    axes[0, 0].legend(loc="lower left", bbox_to_anchor=(-0.02, 0.98), frameon=False, ncols=2, markerscale=2)
    way, parameters = rows[1].subplots(1, 2, width_ratios=(1, 1.6))
    way.semilogy(result.history, color=LINE)
    way.axhline(problem.size[0] - problem.size[1], color="0.6", linestyle="--", linewidth=1)
    way.annotate("noise alone", (len(result.history) - 1, problem.size[0]), color="0.4", ha="right", va="bottom")
    way.set(xlabel="step", ylabel="sum of squares", title=f"{result.method}, {len(result.history) - 1} steps")
    way.grid(alpha=0.25)
    draw_parameters(parameters, result, truth)
    figure.savefig(path, dpi=150)
    print(f"The picture: {path}")


def draw_parameters(ax, result, truth):
    """Start, estimate with three standard errors, and truth of every parameter."""
    names = result.names
    for i, name in enumerate(names):
        right = truth[name]
        value = 100.0 * (result.estimates[name] / right - 1.0)
        error = 300.0 * result.standard_errors[name] / abs(right)
        first = i == 0
        ax.errorbar(
            value, i, xerr=error, fmt="o", color=LINE, capsize=4, label="estimate, 3 std. errors" if first else None
        )
        ax.annotate(
            f"{result.start[name]:.4g} → {result.estimates[name]:.5g} ± {result.standard_errors[name]:.1g}\n"
            f"truth {right:.5g}",
            (1.02, i), xycoords=("axes fraction", "data"), color="0.3", va="center", annotation_clip=False,
        )  # fmt: skip
    ax.axvline(0.0, color=TRUE, linewidth=1.2, label="truth")
    ax.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) + 0.4, -0.6))
    ax.set(xlabel="difference from the truth [%]", title="parameters: all started 20 % off")
    widest = max(abs(x) for x in ax.get_xlim())
    ax.set_xlim(-1.1 * widest, 1.1 * widest)
    ax.grid(alpha=0.25)
    ax.legend(loc="lower left", frameon=False)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    arguments = parser.parse_args()
    result, truth = fit_simulated()
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(result, truth, arguments.out / "fit_bicycle.png")


if __name__ == "__main__":
    main()
