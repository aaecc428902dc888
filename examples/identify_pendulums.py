"""Which parameters of a double and a triple pendulum are identifiable from free swings?

Two and three arms hang from a fixed clamp (Kaheman and co-workers, 2022): 26 swings of 2.7 s, and 22 of 1.5 s,
each from its own initial state. Masses, mass centres, inertias and friction are estimated, but for one mass: 7 and 11
parameters, of which 5 and 8 combinations are identifiable. The combinations that are not identifiable are named. Then
parameters are fixed until the rest is identifiable. The second fit also estimates the zeros of the encoders and the
lengths between the joints, which the authors give as 172.7 and 228.7 mm. Every second swing is fitted; the others are
held out and predicted.

The residuals are not noise. A search for what the model lacks (`forward_selection`) finds the drag of the air at the
tips of the second and third arm and dry friction in two joints, which leave a quarter and a sixth of the errors. The
swings follow each other while the motion decays. The search holds out each third of the decay in turn.

    variable          meaning                                                                unit
    angle1, ...       of each arm from the upright vertical (hanging is pi)                  rad
    mass1, ...        of the arms; free swings determine only ratios: the first is fixed     kg
    center1, ...      mass centre from the arm's upper joint                                 m
    inertia1, ...     about the mass centre, across the plane                                kg m^2
    viscous1, ...     torque in a joint by its rate                                          N m s/rad
    air2, air3        drag at the tip of an arm, by the square of its velocity               kg/m
    dry1, ...         torque of dry friction in a joint                                      N m
    length1, length2  between neighbouring joints                                            m
    zero1, ...        where the encoders read the vertical                                   rad

Run:      python examples/identify_pendulums.py [--out FOLDER]
Appears:  which sums of parameters are identifiable; tables of estimates; the medians of the swings' rms errors,
          fitted and held out; and identify_pendulums.png: the errors of all swings, and one of each pendulum.
Takes:    about two minutes.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.fit import Free, LeastSquares, Simulation, Trial

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"
# Medians [rad] by least squares with free starts, NumPy and SciPy on the same files, all swings fitted.
MEDIAN = {2: 0.0031, 3: 0.0018}
COUNTS = {2: (7, 5), 3: (11, 8)}  # parameters, and identifiable combinations of them


class TwoArms(jk.System):
    mass1: jk.Scalar = jk.parameter(0.1, positive=True, unit="kg")
    mass2: jk.Scalar = jk.parameter(0.1, positive=True, unit="kg")
    center1: jk.Scalar = jk.parameter(0.1, unit="m")
    center2: jk.Scalar = jk.parameter(0.1, unit="m")
    inertia1: jk.Scalar = jk.parameter(0.001, positive=True, unit="kg m^2")
    inertia2: jk.Scalar = jk.parameter(0.001, positive=True, unit="kg m^2")
    viscous1: jk.Scalar = jk.parameter(1e-4, unit="N m s/rad")
    viscous2: jk.Scalar = jk.parameter(1e-4, unit="N m s/rad")
    length1: jk.Scalar = jk.parameter(0.1727, positive=True, unit="m")
    zero1: jk.Scalar = jk.parameter(0.0, unit="rad")
    zero2: jk.Scalar = jk.parameter(0.0, unit="rad")
    air2: jk.Scalar = jk.parameter(0.0, unit="kg/m")
    dry1: jk.Scalar = jk.parameter(0.0, unit="N m")
    dry2: jk.Scalar = jk.parameter(0.0, unit="N m")
    drag1: jk.Scalar = jk.parameter(0.0, unit="N m s^2/rad^2")
    drag2: jk.Scalar = jk.parameter(0.0, unit="N m s^2/rad^2")

    coordinates, speeds = ("angle1", "angle2"), ("rate1", "rate2")
    units = {"angle1": "rad", "angle2": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle1"] - self.zero1, u["rate1"])
        B = N.rotate(3, q["angle2"] - self.zero2, u["rate2"])
        elbow = O.fixed(self.length1 * A.y)
        first = jk.Body(self.mass1, (self.inertia1, 0.0, self.inertia1), O.fixed(self.center1 * A.y), A, name="arm1")
        center = elbow.fixed(self.center2 * B.y)
        return jk.Motion([first, jk.Body(self.mass2, (self.inertia2, 0.0, self.inertia2), center, B, name="arm2")])

    def loads(self, t, q, u, motion, inputs):
        first, second, N = motion["arm1"], motion["arm2"], motion.N
        w1, w2 = jnp.asarray(u["rate1"]), u["rate2"] - jnp.asarray(u["rate1"])
        shoulder = jk.Torque(-friction(w1, self.viscous1, self.dry1, self.drag1) * N.z, first)
        elbow = jk.Torque(-friction(w2, self.viscous2, self.dry2, self.drag2) * N.z, second, first)
        return jk.weight(motion, -9.81 * N.y), shoulder, elbow, drag_at_tip(second, self.air2, N)


def friction(w, viscous, dry, drag):
    return viscous * w + jk.loads.coulomb(w, dry, width=0.1) + jk.loads.quadratic(w, drag)


def drag_at_tip(arm, air, N):
    tip = arm.center.fixed(0.06 * arm.frame.y)
    v = [tip.velocity.dot(axis) for axis in (N.x, N.y)]
    return jk.Force(-air * jnp.sqrt(v[0] ** 2 + v[1] ** 2 + 1e-6) * (v[0] * N.x + v[1] * N.y), tip)


class ThreeArms(TwoArms):
    """The same with a third arm on the second."""

    mass3: jk.Scalar = jk.parameter(0.1, positive=True, unit="kg")
    center3: jk.Scalar = jk.parameter(0.1, unit="m")
    inertia3: jk.Scalar = jk.parameter(0.001, positive=True, unit="kg m^2")
    viscous3: jk.Scalar = jk.parameter(1e-4, unit="N m s/rad")
    length2: jk.Scalar = jk.parameter(0.2287, positive=True, unit="m")
    zero3: jk.Scalar = jk.parameter(0.0, unit="rad")
    air3: jk.Scalar = jk.parameter(0.0, unit="kg/m")
    dry3: jk.Scalar = jk.parameter(0.0, unit="N m")

    coordinates, speeds = ("angle1", "angle2", "angle3"), ("rate1", "rate2", "rate3")
    units = {"angle1": "rad", "angle2": "rad", "angle3": "rad"}

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        second = motion["arm2"]
        joint = second.center.fixed((self.length2 - self.center2) * second.frame.y)
        C = motion.N.rotate(3, q["angle3"] - self.zero3, u["rate3"])
        center = joint.fixed(self.center3 * C.y)
        return motion.extended([jk.Body(self.mass3, (self.inertia3, 0.0, self.inertia3), center, C, name="arm3")])

    def loads(self, t, q, u, motion, inputs):
        third, N, w = motion["arm3"], motion.N, u["rate3"] - jnp.asarray(u["rate2"])
        knee = jk.Torque(-friction(w, self.viscous3, self.dry3, 0.0) * N.z, third, motion["arm2"])
        return (*super().loads(t, q, u, motion, inputs), knee, drag_at_tip(third, self.air3, N))


def fitted(system, recording, free, **options):
    """Parameters, and the angles and rates at the start of each swing; and the swings' rms errors [rad], of which every
    second swing is held out: its start alone is estimated."""
    unknown = (*system.coordinates, *system.speeds)
    fit = jk.fit.fit(system, recording.trials[::2], free, unknown=unknown, optimizer=LeastSquares(), **options)
    held_out = jk.fit.validate(fit, recording.trials[1::2])
    rms = np.full(len(recording.trials), np.nan)
    for k, of in enumerate((fit, held_out)):
        errors = [0.001 * np.array(list(channels.values())) for channels in of.residuals.values()]
        rms[k::2] = [np.sqrt(np.mean(error**2)) for error in errors]
    print(f"{fit}\nrms errors of the swings [mrad]: median and largest")
    for k, of in enumerate(("fitted", "held out")):
        print(f"{of:<10}{1e3 * np.median(rms[k::2]):8.2f}{1e3 * rms[k::2].max():8.2f}")
    print()
    return fit, rms


def check(arms, base, fit, rms):
    """What is held out is as near as in others' fits; what is not identifiable is named. No test repeats these fits."""
    seen = fit.identifiability
    assert np.median(rms[1::2]) < 1.05 * MEDIAN[arms]
    assert (len(seen.names), seen.rank) == COUNTS[arms]
    assert base.count == seen.rank
    assert all(direction.singular_value == 0.0 and len(direction.parts) > 1 for direction in seen.undetermined)
    # With one arm's mass nothing of friction moves: the others' centres and inertias make up for it.
    assert any("viscous" not in direction.text for direction in seen.undetermined)


def identified(system, recording):
    """With all unknown parameters; then with the identifiable ones, zeros and lengths."""
    numbers = range(1, len(system.coordinates) + 1)
    bodies = {f"arm{i}": ("m", "my", "Izz") for i in numbers}
    base = jk.fit.base_parameters(system, bodies=bodies, parameters=[f"viscous{i}" for i in numbers])
    print(base, "\n")
    masses = [f"mass{i}" for i in numbers if i > 1]
    rest = [f"{what}{i}" for what in ("center", "inertia", "viscous") for i in numbers]
    first = fitted(system, recording, [*masses, *rest])
    check(len(numbers), base, *first)
    # Masses, and the first mass centre with them, stay at the first fit's estimates: the rest is identifiable.
    lengths = [name for name in ("length1", "length2") if hasattr(system, name)]
    zeros = [Free(f"zero{i}", scale=0.01) for i in numbers]
    rest.remove("center1")
    fits = {"as described": first, "zeros, lengths": fitted(first[0].system, recording, [*rest, *lengths, *zeros])}
    laws, system = searched(fits["zeros, lengths"][0], numbers)
    free = [*(name for name in rest if "viscous" not in name), *lengths, *zeros]
    free += map(not_negative, laws)
    fits["air, dry friction"] = fitted(system, recording, free, simulation=Simulation(step=0.001))
    assert fits["air, dry friction"][0].ok
    assert np.median(fits["air, dry friction"][1][1::2]) < 0.35 * np.median(fits["zeros, lengths"][1][1::2])
    return fits


def not_negative(name):
    scale = {"air": 1e-3, "drag": 1e-5}.get(name.rstrip("123"), 2e-4)
    return Free(name, start=scale, scale=scale, bounds=(0.0, None))


def searched(fit, numbers):
    """Laws of friction that the search selects: their names, and the system without friction. Every second swing that
    was fitted, at 100 Hz, is enough; viscous frictions may be removed."""
    trials, count = [], len(fit.problem.trials[::2])
    for k, one in enumerate(fit.problem.trials[::2]):
        thinned = [{name: x[::2] for name, x in group.items()} for group in (one.measured, one.initial)]
        trials.append(Trial(one.t[::2], thinned[0], sigma=0.001, initial=thinned[1], labels={"part": 3 * k // count}))
    remove = [f"viscous{i}" for i in numbers]
    system = dataclasses.replace(fit.system, **dict.fromkeys(remove, 0.0))
    free = [item for item in fit.problem.specification.free if "viscous" not in str(item)]
    free += map(not_negative, remove)
    options = {"unknown": fit.problem.specification.unknown, "simulation": Simulation(step=0.005)}
    before = jk.fit.fit(system, trials, free, optimizer=LeastSquares(), **options)
    laws = [f"dry{i}" for i in numbers] + [f"air{i}" for i in numbers if i > 1]
    laws += ["drag1", "drag2"] * (len(numbers) == 2)  # not selected there
    candidates = [Free(name, bounds=(0.0, None)) for name in laws]
    depth = 2 * len(numbers) - 1
    search = jk.fit.forward_selection(before, candidates, remove=remove, depth=depth, refits=2, folds="part")
    print(search, "\n")
    laws = [name for name in search.fit.names if name in (*remove, *search.selected)]
    assert {"dry1", "dry2"} <= set(laws)
    return laws, system


def picture(results, path):
    figure, axes = plt.subplots(len(results), 2, figsize=(9, 6), width_ratios=[1.6, 1], layout="constrained")
    for (swing, errors), (title, fits) in zip(axes, results.items(), strict=True):
        fit, _ = [*fits.values()][-1]
        trial, name = fit.problem.trials[0], fit.trial_names[0]
        for k, (channel, angle) in enumerate(trial.measured.items()):
            label = ("measured", "fitted") if k == 0 else (None, None)
            swing.plot(trial.t, angle, color=INK, linewidth=2.5, alpha=0.35, label=label[0])
            swing.plot(trial.t, fit.fitted[name][channel], color=BLUE, linewidth=1.0, label=label[1])
        swing.set(ylabel="angles [rad]", title=f"{title}: the first swing")
        for color, (label, (_, rms)) in zip((GOLD, BLUE, INK), fits.items(), strict=False):
            errors.plot(1e3 * rms, "-", color=color, linewidth=0.8, label=label)
            errors.plot(range(0, len(rms), 2), 1e3 * rms[::2], "o", color=color, markersize=3)
            errors.plot(range(1, len(rms), 2), 1e3 * rms[1::2], "o", color=color, markersize=3, markerfacecolor="white")
        errors.set(ylabel="rms error [mrad]", title="all swings", ylim=(0, None))
    axes[-1][0].set_xlabel("time [s]")
    axes[-1][1].set_xlabel("number of the swing (hollow: held out)")
    axes[0][0].legend(loc="lower right")
    axes[0][1].legend(loc="upper right")
    figure.savefig(path, dpi=120)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    systems = {"two arms": TwoArms(), "three arms": ThreeArms()}
    results = {}
    for arms, (title, system) in enumerate(systems.items(), start=2):
        recording = jk.data.multi_arm_pendulum(arms)
        print(f"{title}: {recording}")
        results[title] = identified(system, recording)
    picture(results, folder / "identify_pendulums.png")
    print("picture:", folder / "identify_pendulums.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
