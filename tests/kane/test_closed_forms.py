"""A formula in which the textbook errs: the printed form and the corrected one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import CATALOG


@pytest.mark.slow
def test_VC_dot_of_the_bicycle_agrees_with_the_corrected_formula():
    # Example 7, [VC-dot]: in its second and third lines the products stand in the wrong order, R_B2C and [J] are
    # missing. Right is the expression of [VD-dot], with C in the place of D.
    bicycle = CATALOG["WhippleBicycle"].example()
    q, u = (jnp.array(x) for x in (CATALOG["WhippleBicycle"].q, CATALOG["WhippleBicycle"].u))
    q_dot = jk.coordinate_rates(bicycle, 0.0, q, u)

    def along(f):
        return jax.jvp(f, (q,), (q_dot,))

    def R_B2C(q):
        motion = bicycle.motion(0.0, q, jnp.zeros(6))
        return motion["C"].matrix(motion["B"])

    def of_point(pick):  # partial velocities (3,3) of a point, in C
        def columns(q):
            J = jk.constraint_jacobian(bicycle, 0.0, q)

            def velocity(u):
                motion = bicycle.motion(0.0, q, jnp.concatenate([u, J @ u]))
                return pick(motion).velocity.to(motion["C"])

            return jax.jacfwd(velocity)(jnp.zeros(3))

        return columns

    VS, VS_dot = along(of_point(lambda motion: motion["S"]))
    VC, VC_dot = along(of_point(lambda motion: motion["fork"].center))
    J, J_dot = along(lambda q: jk.constraint_jacobian(bicycle, 0.0, q))
    R, R_dot = along(R_B2C)

    def A_and_B(q):  # omega_B = (A + B J) u_I, in B
        (s1, c1), (s2, c2) = ((jnp.sin(x), jnp.cos(x)) for x in (q[0], q[4]))
        O = jnp.zeros(())
        A = jnp.stack([jnp.stack(row) for row in ((c2, O, O), (O, O, O), (s2, O, O))])
        B = jnp.stack([jnp.stack(row) for row in ((-c1 * s2, O, O), (s1, O + 1.0, O), (c1 * c2, O, O))])
        return A, B

    (A, B), (A_dot, B_dot) = along(A_and_B)
    E = jnp.zeros((3, 3)).at[2, 2].set(1.0)
    motion = bicycle.motion(0.0, q, jnp.zeros(6))
    x, _, z = motion["fork"].center.position_from(motion["S"]).to(motion["C"])
    X = jnp.array([[0.0, z, 0.0], [-z, 0.0, x], [0.0, -x, 0.0]])
    np.testing.assert_allclose(VS + X @ (R @ A + E + R @ B @ J), VC, atol=1e-13)  # [VC] as printed is right
    right = VS_dot + X @ (R_dot @ A + R @ A_dot + R_dot @ B @ J + R @ B @ J_dot + R @ B_dot @ J)
    printed = VS_dot + X @ (A @ R_dot + A_dot) + X @ (B @ R_dot + B @ J_dot) + X @ (B_dot @ J_dot)
    np.testing.assert_allclose(right, VC_dot, atol=1e-12)
    assert np.abs(printed - VC_dot).max() > 0.01
