"""Every public function refuses a wrong argument by its name, before a program is traced.

The table contains valid arguments of each function. Each argument is replaced by wrong values in turn. Tests of the
text of a message, of relations between arguments and of values out of range are in the files of their subjects.
"""

import functools
import re
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from mechanisms import Pendulum as Plain

matplotlib.use("Agg")

import jaxkane as jk
from jaxkane._scalarjit import cache_key
from jaxkane.fit import Delay, Fit, Free, Gain, Offset, Problem, Trial
from jaxkane.joints import Actuator, Link, Site, hinge, mechanism
from jaxkane.stability import LinearModel

NAN = float("nan")
TS = np.linspace(0.0, 0.2, 3)
STATE = jk.State([0.3], [0.5])


class Pendulum(Plain):
    def outputs(self, t, q, u, motion, inputs):
        return {"height": -jnp.cos(q["angle"])}


class Falling(Pendulum):
    """With one event."""

    event: Any = eqx.field(static=True, default=None)

    def events(self, t, q, u):
        return {"stop": self.event()}


class Text(str):
    """A string that may be any text, such as a title."""


class Law(float):
    """A number of a law that is evaluated while a program is traced. It may be an array, and NaN becomes a status."""


class Traced(BaseException):
    """A wrong value has reached a program of the library, or the results of a fit."""


class Unused:
    """The linearization of a fit, which a refusal does not need."""

    def __getattr__(self, name):
        raise Traced(name)


class Made:
    """An argument that is made when it is needed. Its wrong values are of another type."""

    def __init__(self, make):
        self.make = functools.cache(make)


@functools.cache
def trial(name="swing"):
    return Trial(TS, {"angle": 0.1 * TS}, {"torque": 0.0 * TS}, sigma=0.1, name=name)


@functools.cache
def problem():
    return Problem.of(Pendulum(), [trial("a"), trial("b")], ["mass"])


@functools.cache
def fitted():
    return Fit(problem(), problem().start, Unused(), np.zeros(2), (1.0,), "converged", "least squares")


def trajectory():
    """Without a simulation."""
    groups = {"t": TS, "q": np.zeros((3, 1)), "u": np.zeros((3, 1)), "u_dep": np.zeros((3, 0)), "x": np.zeros((3, 0))}
    return jk.Trajectory(
        **groups,
        inputs={"torque": np.zeros(3)},
        outputs={},
        status=np.asarray(0),
        t_end=np.asarray(TS[-1]),
        stats={"steps": np.asarray(3), "accepted": np.asarray(3), "rejected": np.asarray(0)},
        names=(("angle",), ("rate",), (), ()),
        events=(),
        adjoint="none",
    )


def fitted_with(item, **more):
    return jk.fit.fit(Pendulum(), trial(), [item(**more)], simulation=STEPS)


def with_event(make, **more):
    return jk.stability.periodic(Falling(event=lambda: make(**more)), STATE, section="stop")


def of_mass(system, value):
    return system.replace({"mass": value}), jk.State(jnp.zeros(1), jnp.zeros(1))


def with_parameter(**more):
    return type("Parametric", (Pendulum,), {"__annotations__": {"p": jk.Scalar}, "p": jk.parameter(**more)})()


N, O = jk.inertial()
P = O.moving(0.5 * N.x, 0.1 * N.x)
B = N.rotate(3, 0.1, 0.2, "B")
BAR = {"mass": 1.0, "center": (0.5, 0.0, 0.0), "inertia": (0.01, 0.1, 0.1)}
STEPS = jk.fit.Simulation(step=0.1)
FILTER = jk.estimate.Filter(Pendulum(), {"rate": 0.1})
URDF = (
    '<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0"/><mass value="2.0"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/><dynamics friction="0.1"/>'
    "</joint></robot>"
)
SPECTRUM = {"values": np.array([1.0, 2.0]), "eigenvalues": np.ones((2, 2)) + 0j}
BELIEF = Made(lambda: jk.estimate.begin(FILTER, STATE, {"angle": 0.1}))

TABLE = {
    "simulate": (
        jk.simulate,
        dict(
            system=Pendulum(), state=STATE, ts=TS, inputs={"torque": 1.0}, rtol=1e-6, atol=1e-6, solver=None,
            max_step=0.1, discontinuities=np.array([0.1]), project=False, stabilize=0.0, adjoint="auto",
            max_steps=100, max_jumps=4,
            progress=False,
        ),
    ),
    "simulate, fixed step": (jk.simulate, dict(system=Pendulum(), state=STATE, ts=TS, step=0.1)),
    "assemble": (jk.assemble, dict(
        system=Pendulum(), q={"angle": 0.3}, u={"rate": 0.1}, t=0.0, free=("angle",), touching=(),
    )),
    "assemble, in order": (jk.assemble, dict(system=Pendulum(), q=np.array([0.3]), u=np.array([0.1]))),
    "State": (lambda q, u: jk.simulate(Pendulum(), jk.State(q, u), TS), dict(q=np.array([0.3]), u=np.array([0.1]))),
    "Samples": (jk.Samples, dict(ts=TS, values=TS, zero_order_hold=False)),
    "accelerations": (jk.accelerations, dict(
        system=Pendulum(), t=0.0, q=np.array([0.3]), u=np.array([0.1]), inputs={"torque": 1.0},
    )),
    "outputs": (jk.outputs, dict(
        system=Pendulum(), t=0.0, q=np.array([0.3]), u=np.array([0.1]), inputs={"torque": 1.0},
    )),
    "impact": (jk.impact, dict(
        system=Pendulum(), t=0.0, q=np.array([0.3]), u=np.array([0.1]), residuals=lambda t, q, u, m: u[0],
        restitution=0.5, release=(),
    )),
    "audit": (jk.audit, dict(system=Pendulum(), trajectory=Made(trajectory))),
    "animate": (jk.animate, dict(
        system=Pendulum(), trajectory=Made(trajectory), speed=1.0, up="y", follow=False, azimuth=1.0, elevation=1.0,
        ground=False, theme="auto", title=Text("a"), height=420,
    )),
    "sweep": (jk.sweep.sweep, dict(
        system=Pendulum(), state=STATE, ts=TS, inputs={"torque": 1.0}, table={"mass": np.array([1.0, 2.0])},
        reduce=lambda ride: ride.q, chunk=2, progress=False,
    )),
    "grid": (jk.sweep.grid, dict(mass=np.array([1.0, 2.0]))),
    "linearize": (jk.stability.linearize, dict(
        system=Pendulum(), motion=jk.State(np.zeros(1), np.zeros(1)), inputs={"torque": 0.0}, t=0.0,
        states=("angle", "rate"), outputs=("angle",), dependent=(), steady=True,
    )),
    "equilibrium": (jk.stability.equilibrium, dict(
        system=Pendulum(), q=np.array([0.3]), inputs={"torque": 0.0}, hold={"angle": 0.3}, find=("torque",), t=0.0,
    )),
    "eigenvalues": (jk.stability.eigenvalues, dict(
        system=Pendulum(), values=np.array([1.0, 2.0]), motion=of_mass, states=("angle", "rate"), modes=("a", "b"),
    )),
    "critical_speeds": (jk.stability.critical_speeds, dict(
        system=Pendulum(), values=np.array([1.0, 2.0]), motion=of_mass, states=("angle", "rate"), modes=("a", "b"),
        most=8,
    )),
    "periodic": (jk.stability.periodic, dict(
        system=Falling(event=lambda: jk.rising(0.1, then={"rate": 0.1})), guess=STATE, inputs={"torque": 0.0},
        section="stop", autonomous=True, hold=(), segments=1, returns=1, t=0.0, rtol=1e-6, atol=1e-6, max_steps=100,
    )),
    "lqr": (jk.stability.lqr, dict(
        model=Made(lambda: LinearModel(
            np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)),
            ("angle", "rate"), ("torque",), ("angle", "rate"),
        )),
        Q=np.eye(2), R=np.eye(1), inputs=("torque",),
    )),
    "fit": (jk.fit.fit, dict(
        system=Pendulum(), trials=Made(lambda: [trial()]), free=("mass",), unknown=("angle",),
        priors={"mass": (1.0, 0.1)}, constraints=(), zero_order_hold=("torque",), window=0.1,
        defect_std={"angle": 0.1}, simulation=STEPS, steps=1, callback=lambda point, cost: None, progress=False,
    )),
    "fit, with noise": (jk.fit.fit, dict(
        system=Pendulum(), trials=Made(lambda: [trial()]), free=("mass",), noise={"rate": 0.1}, simulation=STEPS,
    )),
    "Trial": (Trial, dict(
        t=TS, measured={"angle": TS}, inputs={"torque": TS}, sigma={"angle": 0.1}, initial={"angle": 0.1},
        name=Text("swing"), labels={"speed": 1.0},
    )),
    "Free": (functools.partial(fitted_with, Free), dict(
        where="mass", start=1.0, bounds=(0.0, 2.0), scale=1.0, prior=(1.0, 0.1), name=Text("mass"), unit=Text("kg"),
        each="trial",
    )),
    "Gain": (functools.partial(fitted_with, Gain), dict(
        what="torque", start=1.0, bounds=(0.0, 2.0), scale=1.0, prior=(1.0, 0.1), name=Text("g"), unit=Text(""),
        each="trial",
    )),
    "Offset": (functools.partial(fitted_with, Offset), dict(
        what="torque", start=1.0, bounds=(0.0, 2.0), scale=1.0, prior=(1.0, 0.1), name=Text("g"), unit=Text(""),
        each="trial",
    )),
    "Delay": (functools.partial(fitted_with, Delay), dict(
        what="torque", start=0.05, bounds=(0.0, 0.1), scale=1.0, prior=(1.0, 0.1), name=Text("g"), unit=Text("s"),
        each="trial", before=0.0,
    )),
    "LeastSquares": (jk.fit.LeastSquares, dict(rtol=1e-4, damping=1e-3, horizons=(0.2, 0.5))),
    "Simulation": (jk.fit.Simulation, dict(rtol=1e-6, atol=1e-6, max_steps=100)),
    "Linear": (jk.fit.Linear, dict(factors={"mass": 1.0}, equals=1.0, std=0.1)),
    "forward_selection": (jk.fit.forward_selection, dict(
        fit=Made(fitted), candidates=(Gain("torque"),), remove=(), exchange=False, depth=1, beam=1, refits=3,
        level=0.05, plausible={"mass": 0.2}, folds=2, progress=False,
    )),
    "cross_validate": (jk.fit.cross_validate, dict(fit=Made(fitted), folds=2)),
    "bootstrap": (jk.fit.bootstrap, dict(fit=Made(fitted), n=100, seed=0)),
    "profile": (jk.fit.profile, dict(fit=Made(fitted), name="mass", n=9, span=1.0, level=0.95)),
    "Filter": (jk.estimate.Filter, dict(
        system=Pendulum(), sensors={"rate": 0.1}, noise={"rate": 0.1}, drift={"mass": 0.1}, method="extended", lag=0,
        substeps=1,
    )),
    "begin": (jk.estimate.begin, dict(filter=FILTER, state=STATE, deviation={"angle": 0.1}, t=0.0)),
    "predict": (jk.estimate.predict, dict(filter=FILTER, belief=BELIEF, dt=0.1, inputs={"torque": 1.0})),
    "update": (jk.estimate.update, dict(
        filter=FILTER, belief=BELIEF, measured={"rate": 0.1}, inputs={"torque": 1.0}, age=0,
    )),
    "nees": (jk.estimate.nees, dict(belief=BELIEF, truth=np.zeros(2), age=0)),
    "collocation.Problem": (jk.collocation.Problem, dict(
        system=Pendulum(), duration=1.0, controls=("torque",), cost=lambda t, now: now["torque"] ** 2,
        final_cost=lambda t, now: 0.0, start={"angle": 0.0}, end={"angle": 1.0}, conditions=lambda a, b, d: {},
        within={"angle": (-2.0, 2.0)}, path=lambda t, now: {}, free=("mass",),
    )),
    "collocation.solve": (jk.collocation.solve, dict(
        problem=Made(lambda: jk.collocation.Problem(Pendulum(), 1.0, controls=["torque"])), intervals=4,
        method="hermite-simpson", tolerance=1e-6, options={"a": 1}, starts=1, seed=0, max_iterations=10,
        max_intervals=10, progress=False,
    )),
    "plot.trajectories": (jk.plot.trajectories, dict(
        trajectory=Made(trajectory), names=("angle",), degrees=False, units={"angle": "rad"}, label=Text("a"),
    )),
    "plot.audit": (jk.plot.audit, dict(audit=Made(object))),
    "plot.eigenvalues": (jk.plot.eigenvalues, dict(**SPECTRUM, modes=("a", "b"), xlabel=Text("a"), ylim=(-1.0, 1.0))),
    "plot.root_locus": (jk.plot.root_locus, dict(**SPECTRUM, label=Text("a"))),
    "plot.mode_shapes": (jk.plot.mode_shapes, dict(
        eigenvalues=np.ones(2) + 0j, vectors=np.ones((2, 2)) + 0j, states=("angle", "rate"), modes=("a", "b"),
        only=("angle",),
    )),
    "plot.fits": (jk.plot.fits, dict(
        fit=Made(fitted), trials=("a",), channels=("angle",), residuals=True, units={"angle": "rad"},
    )),
    "plot.residuals": (jk.plot.residuals, dict(
        fit=Made(fitted), over="torque", channels=("angle",), trials=("a",), bins=20,
    )),
    "plot.estimates": (jk.plot.estimates, dict(fits=Made(fitted))),
    "plot.costs": (jk.plot.costs, dict(fit=Made(fitted))),
    "plot.profiles": (jk.plot.profiles, dict(fit=Made(fitted), profiles=Made(object))),
    "plot.selection_path": (jk.plot.selection_path, dict(selection=Made(object))),
    "from_urdf": (jk.convert.from_urdf, dict(
        model=URDF, floating=False, inertias="refuse", merge_fixed=True, stops=("j",), friction=("j",),
        gravity=(0.0, 0.0, -9.81), strict=False, dependent=(), name=Text("robot"),
    )),
    "export.c": (jk.export.c, dict(
        system=Pendulum(), path="pendulum.c", functions=("rates",), name=Text("pendulum"), dtype="float64",
    )),
    "export.numpy": (jk.export.numpy, dict(
        system=Pendulum(), path="pendulum.py", functions=("rates",), dtype="float64",
    )),
    "export.stablehlo": (jk.export.stablehlo, dict(
        system=Pendulum(), path="pendulum.hlo", function="rates", dtype="float64", batch_parameters=False,
        platforms=("cpu",), derivatives=0,
    )),
    "export.fmu": (jk.export.fmu, dict(
        system=Pendulum(), path="pendulum.fmu", fmi="3.0", kind="co-simulation", step=1e-3, state=STATE,
    )),
    "export.c_filter": (jk.export.c_filter, dict(
        filter=FILTER, path="filter.h", belief=BELIEF, name=Text("filter"), dtype="float64", dt=0.01,
    )),
    "export.parameters": (jk.export.parameters, dict(system=Pendulum())),
    "catalog.Belt": (jk.catalog.Belt, dict(mass=1.0, stiffness=1.0, speed=1.0, kinetic=1.0, static=2.0)),
    "catalog.BouncingBall": (jk.catalog.BouncingBall, dict.fromkeys(("mass", "drag", "restitution", "gravity"), 0.5)),
    "parameter": (with_parameter, dict(default=1.0, within=(0.0, 2.0), shape=(), unit=Text("kg"), positive=False)),
    "loads.spring": (jk.loads.spring, dict(P=P, Q=O, stiffness=1.0, length=0.1)),
    "loads.damper": (jk.loads.damper, dict(P=P, Q=O, damping=1.0)),
    "loads.actuator": (jk.loads.actuator, dict(P=P, Q=O, force=1.0)),
    "loads.torsional_spring": (jk.loads.torsional_spring, dict(
        on=B, reaction_on=N, axis=N.z, angle=0.1, stiffness=1.0,
    )),
    "loads.torsional_damper": (jk.loads.torsional_damper, dict(on=B, reaction_on=N, axis=N.z, damping=1.0)),
    "loads.torsional_friction": (jk.loads.torsional_friction, dict(
        on=B, reaction_on=N, axis=N.z, torque=1.0, rate=0.01,
    )),
    "loads.friction": (jk.loads.friction, dict(P=P, Q=O, normal_force=1.0, coefficient=0.5, normal=N.y, speed=0.01)),
    "loads.drag": (jk.loads.drag, dict(P=P, coefficient=1.0, linear=0.1, wind=1.0 * N.x, speed=1e-6)),
    "loads.coulomb": (jk.loads.coulomb, dict(v=Law(0.1), level=Law(1.0), width=Law(0.01))),
    "loads.stribeck": (jk.loads.stribeck, dict(
        v=Law(0.1), kinetic=Law(1.0), static=Law(2.0), falloff=Law(0.1), exponent=Law(2.0), width=Law(0.01),
    )),
    "loads.quadratic": (jk.loads.quadratic, dict(v=Law(0.1), coefficient=Law(1.0))),
    "loads.dead_zone": (jk.loads.dead_zone, dict(x=Law(0.1), lower=Law(-0.1), upper=Law(0.1), width=Law(1e-4))),
    "loads.dc_motor": (jk.loads.dc_motor, dict(
        voltage=Law(1.0), rate=Law(1.0), constant=Law(1.0), resistance=Law(1.0),
    )),
    "loads.bouc_wen": (jk.loads.bouc_wen, dict(
        v=Law(0.1), z=Law(0.1), stiffness=Law(1.0), yield_force=Law(1.0), share=Law(0.5), exponent=Law(1.0),
        width=Law(1e-9),
    )),
    "loads.lugre": (jk.loads.lugre, dict(
        v=Law(0.1), z=Law(0.1), stiffness=Law(1.0), damping=Law(1.0), kinetic=Law(1.0), static=Law(2.0),
        falloff=Law(0.1), viscous=Law(0.0),
    )),
    "loads.rotor": (jk.loads.rotor, dict(
        inertia=1.0, axis=B.x, rate=1.0, carrier=B, at=P, mass=1.0, name=Text("rotor"),
    )),
    "sensors.camera": (jk.sensors.camera, dict(
        point=P, center=O, frame=B, focal_length=Law(1.0), image_center=(0.0, 0.0),
    )),
    "sensors.marker": (jk.sensors.marker, dict(point=P, origin=O, frame=B)),
    "sensors.gyroscope": (jk.sensors.gyroscope, dict(frame=B)),
    "sensors.encoder": (jk.sensors.encoder, dict(angle=Law(0.1), zero=Law(0.0), ratio=Law(1.0), resolution=Law(0.1))),
    "sensors.low_pass": (jk.sensors.low_pass, dict(signal=Law(0.1), x=(0.1,), time_constant=Law(0.1))),
    "sensors.low_pass_second_order": (jk.sensors.low_pass_second_order, dict(
        signal=Law(0.1), x=(0.1, 0.1), frequency=Law(1.0), damping=Law(0.7),
    )),
    "sensors.delayed": (jk.sensors.delayed, dict(signal=Law(0.1), x=(0.1, 0.1), delay=Law(0.1))),
    "Body": (jk.Body, dict(
        mass=1.0, inertia=(1.0, 1.0, 1.0), center=O, frame=B, angular_velocity=1.0 * B.x, name=Text("body"), about=O,
    )),
    "Motion": (jk.Motion, dict(bodies=(jk.Body(1.0, 0.0, O),), constraints=(0.0,), points={"P": P}, frames={"B": B})),
    "Force": (jk.Force, dict(vector=1.0 * N.x, point=P)),
    "Torque": (jk.Torque, dict(vector=1.0 * N.x, on=B, reaction_on=N)),
    "weight": (jk.weight, dict(motion=jk.Motion([jk.Body(1.0, 0.0, O)]), gravity=1.0 * N.x)),
    "Contact": (jk.Contact, dict(point=P, normal=N.y, gap=0.1, restitution=0.5, friction=0.5, static=0.6, surface=O)),
    "DryFriction": (jk.DryFriction, dict(slip=0.1, kinetic=0.5, static=0.6)),
    "Impact": (lambda residuals, **more: jk.Impact(residuals, **more), dict(
        residuals=0.1, restitution=0.5, release=("foot",),
    )),
    "falling": (functools.partial(with_event, jk.falling), dict(quantity=0.1, then={"rate": 0.1}, when=1.0)),
    "rising": (functools.partial(with_event, jk.rising), dict(quantity=0.1, then={"rate": 0.1}, when=1.0)),
    "hinge": (lambda **more: mechanism([Link("a", joints=hinge(**more), **BAR)]), dict(
        name="h", axis=(0.0, 0.0, 1.0), anchor=(0.0, 0.0, 0.0), damping=0.1, stiffness=0.1, rest=0.1, armature=0.1,
        reference=0.1, stops=(-1.0, 1.0), friction=0.1,
    )),
    "Link": (lambda **more: mechanism([Link(**more)]), dict(
        name=Text("a"), joints=(hinge("h"),), position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0), **BAR,
    )),
    "mechanism": (mechanism, dict(
        links=(Link("a", joints=hinge("h"), **BAR),), gravity=(0.0, 0.0, -9.81), actuators=(Actuator("m", "h"),),
        sites=(Site("s", "a"),), loops=(), dependent=(), independent=(), pose={"h": 0.1}, name=Text("Mechanism"),
    )),
}  # fmt: skip


def kind_of(value):
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, (Text, Law)):
        return type(value).__name__
    if isinstance(value, (int, float)):
        return "number"
    if isinstance(value, str):
        return "name"
    if isinstance(value, dict):
        return "mapping"
    if isinstance(value, (tuple, list)) and all(isinstance(x, str) for x in value):
        return "names"
    if isinstance(value, np.ndarray) or (isinstance(value, tuple) and all(kind_of(x) == "number" for x in value)):
        return "array"
    if isinstance(value, tuple):
        return "sequence"
    if callable(value) and not isinstance(value, jk.System):
        return "function"
    return "object"


def wrong_values(value) -> dict[str, Any]:
    match kind_of(value):
        case "flag":
            return {"wrong type": "no"}
        case "Text":
            return {"not finite": NAN, "wrong type": 3, "wrong shape": [["a"]]}
        case "Law":
            return {"wrong type": "a", "empty": []}
        case "number":
            return {"not finite": NAN, "wrong type": "a", "wrong shape": np.full((2, 3), value), "empty": []}
        case "name":
            return {
                "not finite": NAN, "wrong type": 3, "wrong shape": [[value]], "empty": "",
                "unknown name": "unknown_name",
            }  # fmt: skip
        case "array":
            array = np.asarray(value)
            return {
                "not finite": NAN * array, "wrong type": "a", "additional axis": array[None, None],
                "wrong length": np.concatenate([array, array, array[:1]]), "empty": [],
            }  # fmt: skip
        case "names":
            return {
                "not finite": NAN, "wrong type": 3, "wrong shape": [["angle"]], "empty": (),
                "unknown name": ("unknown_name",),
            }  # fmt: skip
        case "mapping":
            (key, old), *_ = value.items()
            entries = wrong_values(old)
            return {f"{kind} of an entry": {**value, key: entry} for kind, entry in entries.items()} | {
                "wrong type": 3, "sequence": [0.5], "empty": {}, "unknown name": {"unknown_name": old},
            }  # fmt: skip
        case "sequence":
            return {"not finite": NAN, "wrong type": "a", "wrong entry": (3.0,), "empty": ()}
        case "function":
            return {"wrong type": 3.0, "text": "a"}
        case _:
            return {"wrong type": 3.0, "text": "a"}


MAY_BE_TRACED = ("predict", "_update", "_eigenvalues_along", "_crossings")
"""Programs that refuse arguments while they are traced. `predict` and `update` are often part of a program."""

ACCEPTED = {
    r".*-(inputs|touching|hold|find|dependent|independent|priors)-empty": "as without it",
    r".*-(noise|drift|deviation|horizons)-empty": "as without it",
    r".*-(constraints|zero_order_hold|defect_std|remove|plausible|stops)-empty": "as without it",
    r".*-(friction|sites|actuators|loops|pose)-empty": "as without it",
    r"collocation\.\w+-(controls|start|end|within|free|options)-empty": "as without it",
    r"assemble-(q|u)-(sequence|empty)": "numbers in order; names that are left out are zero",
    r"assemble-free-empty": "no coordinate is free",
    r"simulate-discontinuities-(wrong length|empty)": "any number of times",
    r"Samples-.*-additional axis": "a batch",
    r"(accelerations|impact|outputs|nees)-(q|u|truth|inputs)-not finite.*": "NaN gives NaN",
    r"(predict|update)-inputs-not finite of an entry": "NaN gives NaN",
    r"update-measured-(not finite of an entry|sequence|empty)": "a missing measurement; numbers in order",
    r"impact-release-empty": "nothing is released",
    r"Impact-release-(empty|unknown name)": "names of a motion that it does not know",
    r"Impact-residuals-(not finite|wrong shape)": "evaluated while it is traced; arrays are flattened",
    r"(sweep|grid)-.*-wrong length.*": "a single column may have any length",
    r"(sweep|grid)-.*-empty.*": "no members",
    r"grid-.*-not finite": "refused by `sweep`",
    r"sweep-inputs-wrong shape of an entry": "samples of each member",
    r"(eigenvalues|critical_speeds)-values-(not finite|wrong length)": "any number; NaN without a motion",
    r"linearize-(outputs|states)-empty": "no rows",
    r"fit-priors-unknown name": "ignored, as its docstring states",
    r"Trial-(inputs|initial|labels)-(empty|unknown name)": "compared with a system later",
    r"Trial-labels-.* of an entry": "any text or number; see tests/fit/test_groups.py",
    r"Trial-(name|sigma)-(not finite|wrong type|wrong shape)": "the text of any object; one number for all channels",
    r"Linear-factors-unknown name": "compared with a system later",
    r"plot\.trajectories-(names|units)-(wrong shape|empty.*|unknown name.*)": "any groups and units",
    r"export\..*-path-unknown name": "any file",
    r"catalog\..*-(wrong shape|empty)": "a batch",
    r"(hinge|Link)-(damping|stiffness|rest|armature|friction|mass)-(wrong shape|empty)": "a batch",
    r"(hinge)-name-unknown name": "any name",
    r"loads\..*-not finite": "evaluated while it is traced; the status is then `INVALID`",
    r"(Body|Contact|DryFriction|sensors\.\w+)-(mass|inertia|gap|slip|image_center|x)-not finite": "as a law",
    r"sensors\.\w+-x-(additional axis|wrong length)": "the state of a batch",
    r"Motion-bodies-empty": "a system of first-order states",
    r"Motion-(points|frames|constraints)-(?!wrong type|sequence).*": "any names and numbers",
    r"parameter-(positive|shape|default)-(wrong shape|empty)": "a batch",
    r"parameter-(positive|shape)-(wrong type|not finite|unknown name)": "see tests/system/test_system.py",
    r"(falling|rising)-(quantity|when)-not finite": "evaluated while it is traced",
    r"(falling|rising)-then-.*": "evaluated when a jump is traced; see tests/integrate/test_jumps.py",
}  # fmt: skip
"""Wrong values that are accepted (patterns of `function-argument-kind`), and why."""

ALIASES = {
    "P": "Point", "Q": "Point", "on": "Frames or Bodies|act on", "reaction_on": "Frames or Bodies|act on",
    "at": "mass centre", "guess": "state", "section": "event", "where": "parameter", "free": "parameter",
    "what": "first argument|no input or channel", "candidates": "free|parameter", "bodies": "Body",
    "x": "number of states", "speed": "smoothing", "rate": "smoothing", "name": "free parameter", "loops": "Coupling",
    "quantity": "event", "when": "event", "default": r"Parametric\.p", "q": "angle", "u": "rate",
    "model": "file", "measured": "measurement",
}  # fmt: skip
"""Other words (a pattern) by which a message names an argument."""

NOT_YET = """
animate-follow: wrong type; animate-ground: wrong type; animate-title: all; sweep-system: wrong type, text;
sweep-state: wrong type, text; sweep-inputs: wrong type, sequence; sweep-table: additional axis of an entry;
sweep-progress: wrong type; linearize-t: wrong type, wrong shape, empty; linearize-steady: wrong type; equilibrium-q:
not finite; eigenvalues-states: empty, unknown name; eigenvalues-modes: all; critical_speeds-values: empty;
critical_speeds-states: empty, unknown name; critical_speeds-modes: all; periodic-rtol: not finite, wrong type, wrong
shape, empty; periodic-atol: not finite, wrong type, wrong shape, empty; periodic-max_steps: all; lqr-model: wrong
type, text; lqr-Q: wrong type; lqr-R: wrong type; fit-constraints: not finite, wrong type; fit-steps: all;
fit-callback: wrong type, text; fit-progress: wrong type; Free-unit: all; Gain-bounds: not finite, additional axis,
wrong length; Gain-unit: all; Offset-bounds: not finite, additional axis, wrong length; Offset-unit: all;
Delay-bounds: not finite, additional axis, wrong length; Delay-unit: all; Delay-before: not finite;
LeastSquares-horizons: not finite, additional axis, wrong length; forward_selection-exchange: wrong type;
forward_selection-plausible: wrong type, sequence; forward_selection-folds: not finite; forward_selection-progress:
wrong type; cross_validate-folds: not finite; bootstrap-seed: all; profile-level: all; begin-filter: wrong type, text;
predict-dt: not finite, wrong type, wrong shape, empty; nees-belief: wrong type, text; collocation.Problem-within:
wrong type, sequence; collocation.solve-method: wrong shape; collocation.solve-options: not finite of an entry, wrong
type of an entry, wrong shape of an entry, empty of an entry, unknown name; collocation.solve-progress: wrong type;
plot.trajectories-trajectory: wrong type, text; plot.trajectories-names: not finite, wrong type;
plot.trajectories-degrees: wrong type; plot.trajectories-units: not finite of an entry, wrong type of an entry, wrong
shape of an entry, wrong type, sequence; plot.trajectories-label: all; plot.eigenvalues-values: not finite, wrong
type; plot.eigenvalues-eigenvalues: wrong type; plot.eigenvalues-xlabel: all; plot.eigenvalues-ylim: all;
plot.root_locus-values: not finite, wrong type; plot.root_locus-eigenvalues: wrong type; plot.root_locus-label: all;
plot.mode_shapes-eigenvalues: wrong type; plot.mode_shapes-vectors: not finite, wrong type; plot.mode_shapes-only:
empty; plot.fits-fit: wrong type, text; plot.fits-trials: not finite, wrong shape, empty; plot.fits-residuals: wrong
type; plot.fits-units: not finite of an entry, wrong type of an entry, wrong shape of an entry, empty of an entry,
unknown name of an entry, empty, unknown name, wrong type, sequence; plot.residuals-fit: wrong type, text;
plot.residuals-over: empty, unknown name, not finite, wrong type, wrong shape; plot.residuals-channels: empty;
plot.residuals-trials: not finite, wrong type, wrong shape, empty; plot.residuals-bins: all; plot.estimates-fits:
wrong type, text; plot.costs-fit: wrong type, text; plot.profiles-fit: wrong type, text; plot.profiles-profiles: wrong
type, text; plot.selection_path-selection: wrong type, text; from_urdf-model: not finite, wrong type, wrong shape;
from_urdf-floating: wrong type; from_urdf-merge_fixed: wrong type; from_urdf-stops: not finite, wrong type, wrong
shape; from_urdf-friction: not finite, wrong type, wrong shape; from_urdf-strict: wrong type; export.c-system: wrong
type, text; export.c-path: not finite, wrong type, wrong shape; export.c-functions: not finite, wrong type, wrong
shape; export.c-name: all; export.c-dtype: not finite, wrong type, wrong shape, empty; export.numpy-path: not finite,
wrong type, wrong shape; export.numpy-functions: not finite, wrong type, wrong shape; export.numpy-dtype: not finite,
wrong type, wrong shape, empty; export.stablehlo-system: wrong type, text; export.stablehlo-path: not finite, wrong
type, wrong shape; export.stablehlo-dtype: not finite, wrong type, wrong shape, empty;
export.stablehlo-batch_parameters: wrong type; export.stablehlo-platforms: not finite, wrong type;
export.stablehlo-derivatives: not finite, wrong type, empty, wrong shape; export.fmu-path: not finite, wrong type,
wrong shape; export.fmu-kind: not finite, wrong type, wrong shape; export.c_filter-path: not finite, wrong type, wrong
shape, empty; export.c_filter-name: all; export.c_filter-dtype: not finite, wrong type, wrong shape, empty;
parameter-within: not finite, wrong type, additional axis, wrong length, empty; loads.spring-stiffness: all;
loads.spring-length: all; loads.damper-damping: all; loads.actuator-force: all; loads.torsional_spring-angle: wrong
type, empty; loads.torsional_spring-stiffness: all; loads.torsional_damper-damping: all;
loads.torsional_friction-torque: all; loads.torsional_friction-rate: wrong type, empty; loads.friction-normal_force:
wrong shape; loads.friction-coefficient: wrong shape; loads.friction-normal: wrong type, text; loads.drag-coefficient:
wrong shape; loads.drag-linear: wrong shape; loads.drag-wind: wrong type, text; loads.rotor-inertia: all;
sensors.camera-center: wrong type, text; sensors.camera-image_center: all; sensors.marker-origin: wrong type, text;
weight-gravity: wrong type, text; hinge-name: wrong shape; hinge-reference: wrong shape, empty
"""
NOT_YET = dict(item.split(": ") for item in " ".join(NOT_YET.split()).split("; "))
"""Findings: wrong values without an error, or with an error that does not name the argument."""


class Case(NamedTuple):
    function: str
    argument: str
    kind: str

    def __str__(self):
        return "-".join(self)

    @property
    def is_accepted(self) -> bool:
        return any(re.fullmatch(pattern, str(self)) for pattern in ACCEPTED)


def cases_of(name, argument) -> list[Case]:
    return [Case(name, argument, kind) for kind in wrong_values(TABLE[name][1][argument])]


ARGUMENTS = [(name, key) for name, (_, valid) in TABLE.items() for key, value in valid.items() if value is not None]


def names(case, message, valid) -> bool:
    """Whether the message names the argument, the entry of a dict, or the unknown name."""
    if case.kind.startswith("unknown name") and "unknown_name" in message and len(message) > 30:
        return True
    words = [case.argument, *(valid if isinstance(valid, dict) and "entry" in case.kind else ())]
    patterns = [re.escape(re.sub("(?<=..)(?<!s)s$", "", word)).replace("_", "[_ -]") for word in words]
    patterns += [ALIASES[case.argument]] if case.argument in ALIASES else []
    flags = re.IGNORECASE if len(case.argument) > 1 else 0
    return any(re.search(rf"\b({pattern})(s|es)?\b", message, flags) for pattern in patterns)


@pytest.fixture(autouse=True, scope="module")
def _no_programs(tmp_path_factory):
    """No simulation is traced, and no program is compiled."""

    def traced(self, arrays):
        if self.f.__name__ in MAY_BE_TRACED:
            original(self, arrays)
        raise Traced(self.f.__qualname__)

    for argument in (value for _, arguments in TABLE.values() for value in arguments.values()):
        if isinstance(argument, Made):
            argument.make()
    original = cache_key._Compiled.traced
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache_key._Compiled, "traced", traced)
        patch.chdir(tmp_path_factory.mktemp("exports"))
        yield


def made(value):
    return value.make() if isinstance(value, Made) else value


def fault_of(case) -> str:
    """What happens instead of a refusal that names the argument; empty if it is refused."""
    function, valid = TABLE[case.function]
    arguments = {key: made(value) for key, value in valid.items()}
    arguments[case.argument] = wrong_values(valid[case.argument])[case.kind]
    errors = (TypeError, ValueError, *((KeyError,) if case.kind.startswith("unknown name") else ()))
    errors += (OSError,) if case.argument in ("path", "model") else ()
    try:
        function(**arguments)
        plt.close("all")
    except errors as error:
        return "" if names(case, str(error), valid[case.argument]) else f"the message does not name it: {error}"
    except (Exception, Traced) as error:
        return repr(error)
    return "no exception"


@pytest.mark.parametrize(("name", "argument"), [pytest.param(*pair, id="-".join(pair)) for pair in ARGUMENTS])
def test_a_wrong_argument_is_refused_by_name(name, argument):
    cases = [case for case in cases_of(name, argument) if not case.is_accepted]
    faults = {case.kind: fault for case in cases if (fault := fault_of(case))}
    listed = {*NOT_YET.get(f"{name}-{argument}", "").split(", ")} - {""}
    listed = {case.kind for case in cases} if "all" in listed else listed
    assert not {kind: fault for kind, fault in faults.items() if kind not in listed}
    assert not listed - {*faults}, "These are refused now: remove them from NOT_YET."


def test_listed_exceptions_are_cases():
    """Of the lists above, for names that have changed."""
    every = [case for pair in ARGUMENTS for case in cases_of(*pair)]
    assert not [p for p in ACCEPTED if not any(re.fullmatch(p, str(case)) for case in every)]
    assert NOT_YET.keys() <= {"-".join(pair) for pair in ARGUMENTS}
