"""Small mutations of the library, and the tests that find them. Run this script by hand; pytest does not collect it.

    python tests/mutations.py                    all mutations, with the tests that are not slow
    python tests/mutations.py --only 7 riders    mutations by their number or by a part of their name
    python tests/mutations.py --all              also with the slow tests
    python tests/mutations.py --list             the mutations, and whether each fits the source

Each mutation changes one place in a copy of `src`: a sign, an index, a term, a comparison. Pytest then runs the nearest
test files with this copy until a test fails. A mutation that survives shows a fault that no test would find. The old
text of a mutation must occur once in its file. If the source has changed, change the mutation too.

The script uses its own folder of compiled programs, or that of JAXKANE_TEST_CACHE. The first run compiles everything
and takes longer.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
CACHE = "JAXKANE_TEST_CACHE"
LONGEST = 600.0  # s; a mutation can cause an endless loop


class Mutation(NamedTuple):
    """A change of one place of the library.

    Fields:

    - `name`: the fault, in words.
    - `file`: the source file, in `src/jaxkane`.
    - `old`, `new`: the text to replace, which must occur once, and its replacement.
    - `near`: test files or folders in `tests` that are most likely to find the fault, the cheapest first, separated by
      spaces.
    """

    name: str
    file: str
    old: str
    new: str
    near: str


# fmt: off
MUTATIONS = (
    # -- Kane's equations, constraints, assembly
    Mutation("rates of momenta: the factors of omega x p are exchanged", "_kane/kanes_method.py",
             "cross(omega, x)) for x_dot", "cross(x, omega)) for x_dot",
             "catalog/test_laws.py"),
    Mutation("least change of coordinates: the change is not scaled by the weights", "_kane/constraint_residuals.py",
             "* RowBasis.of(G * weights[None]).least_norm(h)", "* 0.0 + RowBasis.of(G).least_norm(h)",
             "kane/test_constraints.py kane/test_units.py estimate/test_filter.py"),
    Mutation("assembly: coordinates that the constraints do not determine are accepted", "_kane/consistent_state.py",
             "converged = finite & is_met & implied_is_met & is_determined",
             "converged = finite & is_met & implied_is_met",
             "kane/test_assembly.py kane/test_checks.py kane/test_constraints.py joints"),
    # -- Kinematics
    Mutation("frames by a function: the angular velocity has the other sign", "_system/kinematics.py",
             "0.5 * (skew[k, j] - skew[j, k])", "0.5 * (skew[j, k] - skew[k, j])",
             "system/test_kinematics.py"),
    # -- Jumps, held inputs, steps
    Mutation("jumps: a sample at the time of a jump has the state before it", "_integrate/loop.py",
             "cut = cut - 16 * rounding(", "cut = cut + 16 * rounding(",
             "integrate/test_jumps.py integrate/test_contact_laws.py"),
    Mutation("held inputs: the end of a fixed step uses the value before it", "_integrate/inputs.py",
             "jnp.where(at > end - margin, end + margin, moved)", "jnp.where(at > end - margin, end - margin, moved)",
             "integrate/test_zero_order_hold.py integrate/test_dense_samples.py integrate/test_steps.py"),
    Mutation("step control: the way to a discontinuity is not divided in half", "_integrate/step_control.py",
             "jnp.where(t1 >= stop, stop, jnp.minimum(t1, halfway))", "jnp.where(t1 >= stop, stop, t1)",
             "integrate/test_steps.py integrate/test_dense_samples.py integrate/test_zero_order_hold.py"),
    # -- Loads, sensors
    Mutation("Bouc-Wen: the sign of the rate instead of that of rate times extension", "loads.py",
             "along = share * jnp.sign(v * z)", "along = share * jnp.sign(v)",
             "loads/test_elements.py"),
    Mutation("sensors: the rounding of an encoder has a derivative", "sensors.py",
             "jax.lax.stop_gradient(jnp.round(steps) - steps)", "(jnp.round(steps) - steps)",
             "system/test_sensors.py"),
    # -- Compiler
    Mutation("derivatives of programs: one rule for operations with different parameters", "_scalarjit/jaxpr.py",
             "key = (equation.primitive, parameters, differentiated, types, settings())",
             "key = (equation.primitive, differentiated, types, settings())",
             "scalarjit/test_function.py scalarjit/test_linear_solution.py catalog/test_derivatives.py"),
    Mutation("cache key: the object of a method does not belong to it", "_scalarjit/cache_key.py",
             "parts = value.__func__, value.__self__", "parts = (value.__func__,)",
             "scalarjit/test_cache_key.py scalarjit/test_cache.py"),
    Mutation("linear solves: an exchange of rows does not change the sign of the determinant",
             "_scalarjit/components.py",
             "_chosen(is_larger, mul(-1.0, det), det)", "_chosen(is_larger, det, det)",
             "scalarjit/test_scalars_linear.py"),
    # -- Fits
    Mutation("priors: that of a trial is counted in each of its windows", "fit/problem/model.py",
             "of_trial = jnp.where(window.first, b / n.trial_deviation, 0.0)", "of_trial = b / n.trial_deviation",
             "fit/test_linear.py fit/test_groups.py fit/test_uncertainty.py fit/test_transcriptions.py"),
    Mutation("statistics: the covariance takes priors for data", "fit/result/statistics.py",
             "return variance * inverse + (1.0 - variance) * inverse @ of_priors @ inverse",
             "return variance * inverse",
             "fit/test_linear.py fit/test_uncertainty.py"),
    Mutation("process noise: the information has no factor sqrt(2) for standard deviations", "fit/solve/kalman.py",
             "2**0.5 * s_dot / s[:, None], priors_dot", "s_dot / s[:, None], priors_dot",
             "fit/test_noise.py"),
    Mutation("delays: the slope between unequal intervals has exchanged weights", "fit/problem/model.py",
             "(d[:-1] * h[1:] + d[1:] * h[:-1])", "(d[:-1] * h[:-1] + d[1:] * h[1:])",
             "fit/test_delayed_signal.py"),
    Mutation("groups: the likelihood of deviations is not restricted", "fit/solve/fit.py",
             "nu = problem.size[0] - problem.size[1]\n\n    def criterion", "nu = problem.size[0]\n\n    def criterion",
             "fit/test_groups.py"),
    Mutation("cross-validation: the interval is that of a mean, not that of the next trial", "fit/result/validation.py",
             "* (1 + 1 / K) ** 0.5", "* (1 / K) ** 0.5",
             "fit/test_validation.py fit/test_coverage.py fit/test_linear.py"),
    Mutation("forward selection: an estimate on the wrong side has a small p-value", "fit/extend/selection.py",
             "return score.p / 2 if inside else 1.0 - score.p / 2", "return score.p / 2",
             "fit/test_forward_selection.py"),
    # -- Filters, optimal control, stability
    Mutation("Kalman filter: Potter's update divides by s^2", "estimate/_filter_step.py",
             "jnp.outer(moved, f) / (s * (s + r))", "jnp.outer(moved, f) / s**2",
             "estimate/test_filter.py"),
    Mutation("multipliers of collocation: those of fixed variables are zero", "collocation/_solve.py",
             "np.where(fixed, -lagrangian_gradient(program, solution)", "np.where(fixed, 0.0",
             "collocation/test_known_solutions.py collocation/test_plans.py"),
    Mutation("eigenvalues: the smaller root of a block suffers from cancellation", "stability/_matrix_eigenvalues.py",
             "far = jnp.where(p < 0, p - root, p + root)", "far = p + root",
             "stability/test_stability_eig.py stability/test_stability_eigenvalues.py"),
    Mutation("equilibrium: a motion that belongs to a family is accepted", "stability/_steady.py",
             "is_root = (r <= tolerance) & (slopes[-1] > tolerance)", "is_root = r <= tolerance",
             "stability/test_stability_steady.py stability/test_stability_units.py"),
    # -- Bicycles, import, export, sweeps
    Mutation("riders: the product of inertia is moved with the other sign", "bicycles/_rider.py",
             "Ixz - m * x * z", "Ixz + m * x * z",
             "bicycles/test_bicycle_riders.py"),
    Mutation("URDF: an inertia is turned backwards", "convert/_urdf.py",
             "else R @ I @ R.T", "else R.T @ I @ R",
             "convert/test_urdf.py"),
    Mutation("C: the larger of NaN and a number is the number", "export/_source.py",
             "return a != a || (a == b ? !signbit(a) : a > b) ? a : b;",
             "return (a == b ? !signbit(a) : a > b) ? a : b;",
             "export/test_export.py"),
    Mutation("FMU: the state after a jump is not continued to the present time", "export/fmu_steps_template.c",
             "m->now.y[i] = after[i] - shift * rate[i];", "m->now.y[i] = after[i];",
             "export/test_fmu.py"),
    Mutation("sweeps: new parameters do not change dependent coordinates", "sweep/_members.py",
             "if system.dependent_coordinates and (q or parameters):", "if system.dependent_coordinates and q:",
             "sweep/test_sweep_tables.py sweep/test_sweep.py"),
    # -- Faults that have survived the plain tests before
    Mutation("events: the last crossing of a cubic instead of the first", "_integrate/events.py",
             "passes = ~any_passes & (way * last < 0)", "passes = (way * last < 0)",
             "integrate/test_events.py"),
    Mutation("tyres: the relaxation has the other sign of camber", "bicycles/_tyre.py",
             "lag = deflection / self.relaxation_length - self.equivalent(camber)",
             "lag = deflection / self.relaxation_length + self.equivalent(camber)",
             "bicycles/test_bicycle_tyres.py bicycles/test_bicycles.py"),
    Mutation("common subexpressions: a - b is taken for b - a", "_scalarjit/jaxpr.py",
             "key = (equation.primitive, *of_xs, _parameters_of",
             "key = (equation.primitive, *sorted(of_xs, key=str if equation.primitive.name == 'sub' else lambda _: 0), "
             "_parameters_of",
             "scalarjit/test_function.py catalog/test_laws.py scalarjit/test_linear_solution.py"),
    Mutation("collocation: the range at an end replaces the bounds along the motion", "_collocate/transcription.py",
             "lower[i], upper[i] = max(low, lower[i]), min(high, upper[i])", "lower[i], upper[i] = low, high",
             "collocation"),
    Mutation("collocation: states that no rate uses need not be periodic", "_collocate/transcription.py",
             "if k >= n_q or k in used)", "if k in used)",
             "collocation"),
    Mutation("mesh: intervals are merged at the tolerance instead of a tenth of it", "collocation/_mesh.py",
             "** (order + 1) < 0.1 * tolerance:", "** (order + 1) < tolerance:",
             "collocation"),
    Mutation("mesh: the error of the cost is not multiplied by the length of the interval", "collocation/_mesh.py",
             "return np.abs(exact - coarse) * steps", "return np.abs(exact - coarse)",
             "collocation"),
    Mutation("orbits: the trivial multiplier compares with the segment before", "stability/_orbit_equations.py",
             "after = jnp.roll(f, -1, axis=0)", "after = jnp.roll(f, 1, axis=0)",
             "stability/test_periodic.py"),
    Mutation("orbits: the first return may be far from the start", "stability/_periodic.py",
             "found = [i for i in crossed if equations.section or far[i] <= 0.25 * np.max(far)]", "found = crossed",
             "stability/test_periodic.py"),
    Mutation("contacts: the friction of two corners is not proportional to their limits", "_kane/contact/laws.py",
             "shares = jnp.clip(limits / jnp.where(largest > 0, largest, 1.0), 1e-8, 1.0)",
             "shares = jnp.ones_like(limits)",
             "integrate/test_contact_systems.py integrate/test_contact_laws.py"),
    Mutation("contacts: all sliding contacts stop when one does", "_kane/contact/states_after_jump.py",
             "stops |= jnp.any(stops) & is_slow & (memory.states == SLIDES) & ~bearing",
             "stops |= jnp.any(stops) & (memory.states == SLIDES) & ~bearing",
             "integrate/test_contact_systems.py integrate/test_contact_laws.py integrate/test_contact_options.py"),
    Mutation("contacts: sticking is limited by the kinetic friction", "_kane/contact/laws.py",
             "(force - self.slip.static * L[:, 0])", "(force - self.friction * L[:, 0])",
             "integrate/test_contact_laws.py integrate/test_contact_systems.py"),
)
# fmt: on


def why_it_does_not_fit(mutation: Mutation) -> str:
    """Why a mutation of the library is not possible; an empty text if it is."""
    text = (ROOT / "src/jaxkane" / mutation.file).read_text(encoding="utf-8")
    if text.count(mutation.old) != 1:
        return f"its old text occurs {text.count(mutation.old)} times in {mutation.file} instead of once"
    missing = [name for name in mutation.near.split() if not (ROOT / "tests" / name).exists()]
    return f"these tests do not exist: {', '.join(missing)}" if missing else ""


def outcome(mutation: Mutation, with_slow: bool, cache: str) -> str:
    """Whether the nearest tests find one mutation, and by which test."""
    with tempfile.TemporaryDirectory(prefix="jaxkane-mutation-") as folder:
        copy = Path(folder) / "src"
        # With the compiled modules: their times are those of the source files, so Python uses all but the mutated one.
        shutil.copytree(ROOT / "src", copy)
        path = copy / "jaxkane" / mutation.file
        path.write_text(path.read_text(encoding="utf-8").replace(mutation.old, mutation.new), encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(copy), CACHE: cache}
        # The copy must have precedence over the installed library.
        command = [sys.executable, "-c", "import jaxkane; print(jaxkane.__file__)"]
        file = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        assert Path(file.split()[-1]).is_relative_to(copy), file
        options = ["-x", "-q", "-n0", "-p", "no:cacheprovider", "-m", "" if with_slow else "not slow"]
        tests = [str(Path("tests") / name) for name in mutation.near.split()]
        command = [sys.executable, "-m", "pytest", *options, *tests]
        try:
            run = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=LONGEST)
        except subprocess.TimeoutExpired:
            return f"killed by a time-out of {LONGEST:g} s"
    lines = run.stdout.splitlines()
    failed = [line.split(" - ")[0].split(" ", 1)[1] for line in lines if line.startswith(("FAILED ", "ERROR "))]
    if failed and "::" not in failed[0]:  # the tests cannot be imported, perhaps also without the mutation
        return f"not tested: {failed[0]} cannot be imported"
    if run.returncode in (0, 5):  # 5: all tests are slow
        return "survived"
    return f"killed by {failed[0] if failed else f'the exit code {run.returncode}'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME_OR_NUMBER", help="mutations by number or part of the name")
    parser.add_argument("--all", action="store_true", help="run the slow tests too")
    parser.add_argument("--list", action="store_true", help="list the mutations and check that they fit the source")
    options = parser.parse_args()
    mutations = [
        (i, m)
        for i, m in enumerate(MUTATIONS, start=1)
        if options.only is None or any(i == int(x) if x.isdigit() else x in m.name for x in options.only)
    ]
    wrong = {i: why for i, m in mutations if (why := why_it_does_not_fit(m))}
    if options.list or wrong:
        for i, m in mutations:
            print(f"{i:3} {m.name}\n    {m.file}; {m.near} {wrong.get(i, '')}")
        sys.exit(1 if wrong else 0)
    cache, found = os.environ.get(CACHE) or str(Path(tempfile.gettempdir()) / "jaxkane-mutation-programs"), []
    for i, m in mutations:
        found.append(outcome(m, options.all, cache))
        print(f"{i:3} {m.name}: {found[-1]}", flush=True)
    print(f"{sum(text.startswith('killed') for text in found)} of {len(found)} mutations are found")


if __name__ == "__main__":
    main()
