"""Laws that every entry of `CATALOG` obeys. A new entry is tested here without a line being written."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxkane as jk
from jaxkane.catalog import CATALOG

T = 0.3  # [s]: by then the engines of Example 5 have changed their speed
INPUTS = np.random.default_rng(5).uniform(0.5, 2.0, 12)


class Example:
    """An entry at its state, moving, with all its inputs at work."""

    def __init__(self, name):
        self.entry = CATALOG[name]
        self.system = self.entry.example()
        self.q, self.u = jnp.array(self.entry.q), jnp.array(self.entry.u)
        self.inputs = {name: float(x) for name, x in zip(self.system.inputs, INPUTS, strict=False)}
        self.at = (self.system, T, self.q, self.u)
        self.u_dot = jk.accelerations(*self.at, self.inputs)
        self.q_dot = jk.coordinate_rates(*self.at)

    def along_motion(self, f):
        """f(t, q, u) and its time derivative."""
        return jax.jvp(f, (jnp.array(T), self.q, self.u), (jnp.array(1.0), self.q_dot, self.u_dot))

    def all_speeds(self, t, q, u):
        """The independent and the dependent speeds."""
        return jnp.concatenate([u, jk.dependent_speeds(self.system, t, q, u)])

    def motion(self, t, q, u):
        return self.system.motion(t, q, self.all_speeds(t, q, u))

    def velocities(self, t, q, u):
        """(b, 2, 3) in N: of the mass centres, and angular."""
        motion = self.motion(t, q, u)
        pairs = [(body.center.velocity, body.angular_velocity) for body in motion.bodies]
        return jnp.stack([jnp.stack([x.to(motion.N) for x in pair]) for pair in pairs])

    def momenta(self, t, q, u):
        """(b, 2, 3) in N: linear, and angular about the mass centres."""
        motion = self.motion(t, q, u)
        pairs = []
        for body in motion.bodies:
            H = jnp.array(body.inertia) @ body.angular_velocity.to(body.frame)
            pairs.append((body.mass * body.center.velocity.to(motion.N), motion.N.matrix(body.frame) @ H))
        return jnp.stack([jnp.stack(pair) for pair in pairs])

    def loads(self, u, inputs):
        """Forces and torques (l, 3), and the velocities they work on (l, 3), in N."""
        u_all, motion = self.all_speeds(T, self.q, u), self.motion(T, self.q, u)
        values = dict.fromkeys(self.system.inputs, 0.0) | inputs
        loads = self.system.loads(T, self.q, u_all, motion, values)
        loads = jax.tree.leaves(loads, is_leaf=lambda x: isinstance(x, jk.Force | jk.Torque))
        if not loads:
            return jnp.zeros((0, 3)), jnp.zeros((0, 3))
        in_N = lambda x: x.to(x.frame.root)  # noqa: E731
        return jnp.stack([in_N(x.vector) for x in loads]), jnp.stack([in_N(x.velocity) for x in loads])

    def power(self, u, inputs):
        forces, velocities = self.loads(u, inputs)
        return jnp.sum(forces * velocities)


_example = functools.cache(Example)


# One of each kind is enough for a plain run; CI asks all of them.
QUICK = {"DoublePendulum", "RigidBody", "BarWithPiston", "DiskAndBar", "SpinningTop"}


@pytest.fixture(params=[name if name in QUICK else pytest.param(name, marks=pytest.mark.weekly) for name in CATALOG])
def example(request):
    return _example(request.param)


def assert_close(a, b, rtol, scale=None):
    """Largest difference relative to the largest entry of `b`, or to `scale`."""
    scale = np.abs(b).max(initial=0.0) if scale is None else scale
    np.testing.assert_allclose(a, b, rtol=0, atol=max(rtol * float(scale), 1e-300))


def test_the_example_state_satisfies_the_configuration_constraints(example):
    system, q = example.system, example.q
    assert len(example.entry.q) == len(system.coordinates)
    assert len(example.entry.u) == len(system.speeds)
    assert_close(np.array([float(x) for x in system.configuration_constraints(T, q)]), 0.0, 1e-14, scale=1.0)


# Laws that only some entries can obey: those with constraints of the configuration, and with dependent speeds.
CLASSES = {name: getattr(jk.catalog, name) for name in CATALOG}
CONSTRAINED = [k for k, x in CLASSES.items() if x.configuration_constraints is not jk.System.configuration_constraints]
DEPENDENT = [k for k, x in CLASSES.items() if x.dependent_speeds]


@pytest.mark.slow_cases("WhippleBicycle", "AircraftEulerParameters")
@pytest.mark.parametrize("name", CONSTRAINED)
def test_coordinate_rates_satisfy_the_configuration_constraints(name):
    example = _example(name)
    system = example.system
    _, h_dot = example.along_motion(lambda t, q, u: jnp.stack([*system.configuration_constraints(t, q)]))
    assert_close(h_dot, 0.0, 1e-13, scale=np.abs(example.q_dot).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", DEPENDENT)
def test_dependent_speeds_satisfy_the_constraints_and_match_their_accelerations(name):
    example = _example(name)
    u_all, motion = example.all_speeds(*example.at[1:]), example.motion(*example.at[1:])
    assert_close(jnp.stack([*motion.constraints]), 0.0, 1e-13, scale=np.abs(u_all).max())
    u_dep, u_dep_dot = example.along_motion(lambda t, q, u: jk.dependent_speeds(example.system, t, q, u))
    assert u_dep.shape == (len(example.system.dependent_speeds),)
    assert_close(jk.dependent_accelerations(*example.at, example.inputs), u_dep_dot, 1e-11)


def test_mass_matrix_is_symmetric_and_positive_definite(example):
    M = jk.mass_matrix(*example.at)
    assert_close(M, M.T, 1e-14)
    assert np.linalg.eigvalsh(M).min() > 0


@pytest.mark.slow
def test_mass_matrix_is_the_hessian_of_the_kinetic_energy(example):
    # T is a quadratic form of the speeds, drift apart, and M its matrix: d2T/du2 = M
    M = jk.mass_matrix(*example.at)
    system, t, q, u = example.at
    assert_close(M, jax.hessian(lambda u: jk.kinetic_energy(system, t, q, u))(u), 1e-12)


@pytest.mark.slow_cases(all_but=["SpinningTop"])
def test_generalized_forces_balance_at_the_accelerations(example):
    Fr = jk.generalized_active_forces(*example.at, example.inputs)
    Fr_star = jk.generalized_inertia_forces(*example.at, example.inputs, u_dot=example.u_dot)
    M, f = jk.equations_of_motion(*example.at, example.inputs)
    scale = np.abs(M @ example.u_dot).max() + np.abs(Fr).max()
    assert_close(Fr + Fr_star, 0.0, 1e-11, scale)
    assert_close(M @ example.u_dot, f, 1e-11, scale)
    # F_r = sum V_r . dp/dt + W_r . dH/dt, with momenta resolved in N before they are differentiated: no omega x there
    _, momentum_rates = example.along_motion(example.momenta)
    partials = np.stack(jk.partial_velocities(*example.at), axis=1)  # (b,2,3,n)
    assert_close(Fr, np.einsum("bvxn,bvx->n", partials, momentum_rates), 1e-11, scale)


def test_velocities_are_the_sum_of_partial_velocities_and_drift(example):
    # v = V u + v_t,  omega = W u + omega_t
    V, W = map(np.asarray, jk.partial_velocities(*example.at))
    _, t, q, u = example.at
    drift = example.velocities(t, q, jnp.zeros_like(u))
    partial = np.stack([V @ u, W @ u], axis=1)
    assert_close(partial + drift, example.velocities(t, q, u), 1e-13)


def test_power_of_the_loads_is_the_rate_of_kinetic_energy(example):
    # dT/dt = F . v + [dp/dt . v_t + dH/dt . omega_t - F . v_t]; the bracket is the power of prescribed motions, where
    # the index t marks velocities that are left when the speeds are zero
    system, t, q, u = example.at
    _, T_dot = example.along_motion(lambda t, q, u: jk.kinetic_energy(system, t, q, u))
    _, momentum_rates = example.along_motion(example.momenta)
    drift = example.velocities(t, q, jnp.zeros_like(u))
    forces, velocities = map(np.asarray, example.loads(u, example.inputs))
    _, load_drift = map(np.asarray, example.loads(jnp.zeros_like(u), example.inputs))
    momentum_rates, drift = np.asarray(momentum_rates), np.asarray(drift)
    prescribed = np.sum(momentum_rates * drift) - np.sum(forces * load_drift)
    scale = np.abs(momentum_rates * example.velocities(t, q, u)).sum() + np.abs(forces * velocities).sum()
    assert_close(T_dot, np.sum(forces * velocities) + prescribed, 1e-12, scale)


def test_the_conservative_flag_agrees_with_the_power_of_the_loads(example):
    # The power of conservative loads changes its sign with the speeds; a damper's does not.
    u, none = example.u, {}
    odd = abs(example.power(u, none) + example.power(-u, none)) <= 1e-12 * abs(example.power(u, none))
    scleronomic = not np.any(example.velocities(T, example.q, jnp.zeros_like(u)))
    assert example.entry.conservative == bool(odd and scleronomic)


def test_derivatives_of_orientations_agree_with_angular_velocities(example):
    # dR/dt R^T = [omega x], R from the frame's components to those in N
    def frames(motion):
        return [body.frame for body in motion.bodies] + list(motion.frames.values())

    def rotations(t, q, u):
        motion = example.motion(t, q, u)
        return jnp.stack([motion.N.matrix(frame) for frame in frames(motion)])

    R, R_dot = example.along_motion(rotations)
    motion = example.motion(T, example.q, example.u)
    for A, A_dot, frame in zip(R, R_dot, frames(motion), strict=True):
        x, y, z = frame.angular_velocity.to(motion.N)
        assert_close(A @ A.T, np.eye(3), 1e-14)
        assert_close(A_dot @ A.T, np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), 1e-13, 1 + abs(x + y + z))


def test_derivatives_of_mass_centre_positions_agree_with_velocities(example):
    # Of the mass centres only: a contact point may be named, whose velocity is that of the wheel's matter.
    def positions(t, q, u):
        motion = example.motion(t, q, u)
        return jnp.stack([body.center.position.to(motion.N) for body in motion.bodies])

    _, rates = example.along_motion(positions)
    velocities = example.velocities(T, example.q, example.u)[:, 0]
    assert_close(rates, velocities, 1e-12, scale=np.abs(velocities).max() + 1e-3)


@pytest.mark.slow
def test_derivatives_equal_central_differences(example):
    rtol = 1e-6
    x, unravel = ravel_pytree((example.system, example.q, example.u))

    def f(x):
        system, q, u = unravel(x)
        return jk.accelerations(system, T, q, u, example.inputs)

    directions = np.eye(x.size)
    steps = np.diag(1e-5 * np.where(x == 0.0, 0.1, np.abs(x)))
    weights = INPUTS[: example.u.size]

    @jax.jit
    def derivatives(x):
        differences = jax.vmap(lambda dx: f(x + dx) - f(x - dx))(steps) / (2 * jnp.sum(steps, 1, keepdims=True))
        forward = jax.vmap(lambda dx: jax.jvp(f, (x,), (dx,))[1])(directions)
        return differences, forward, jax.grad(lambda x: weights @ f(x))(x)

    differences, forward, reverse = map(np.asarray, derivatives(x))
    sizes = np.abs(x)[:, None]  # a derivative by a small parameter is judged by what the parameter does
    for derivative, difference in zip(forward * sizes, differences * sizes, strict=True):
        assert_close(derivative, difference, rtol, scale=np.abs(difference).max() + 1e-3 * np.abs(example.u_dot).max())

    assert_close(directions @ reverse, forward @ weights, 1e-11)


def test_results_are_the_same_under_jit_and_vmap(example):
    def f(u):
        return jk.accelerations(example.system, T, example.q, u, example.inputs)

    batch = jnp.outer(jnp.array([1.0, 0.5, -1.2]), example.u)
    one_by_one = np.stack([f(u) for u in batch])
    assert_close(jax.jit(jax.vmap(f))(batch), one_by_one, 1e-11)
