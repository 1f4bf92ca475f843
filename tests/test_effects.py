"""What a scene does not call for leaves no trace in the program."""

import jax
import jax.numpy as jnp
import pytest

import vsr_jax as vsr
from vsr_jax.studies.timing import primitives

ARM = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45, density=1000.0))
PATH = vsr.Parallel(0.007, 0.0)
STEPS = vsr.StrainDependent(8)


def operations(scene):
    """How often each primitive occurs in the solve of a scene, nested programs included."""
    values = jnp.zeros(len(scene.actuators))
    program = jax.make_jaxpr(lambda inputs: STEPS.solve(scene, inputs).state.xi)(values)
    return primitives(program)


@pytest.fixture(scope="module")
def plain():
    return operations(vsr.Scene(ARM, [vsr.Tendon(PATH)]))


def test_tendons_alone_have_no_pass_along_the_arm(plain):
    assert plain["while"] == 1
    assert not any(
        plain[name] for name in ("scan", "sin", "cos", "exp", "cumsum", "custom_linear_solve", "lu")
    )


def test_gravity_brings_the_passes_and_nothing_else():
    loaded = operations(vsr.Scene(ARM, [vsr.Tendon(PATH)], [vsr.Gravity()]))
    assert loaded["scan"] >= 3
    assert not any(loaded[name] for name in ("lu", "exp"))


def test_follower_loads_alone_carry_the_change_of_the_force():
    dead = operations(vsr.Scene(ARM, [vsr.Tendon(PATH)], [vsr.TipWrench((0.0, 0.0, 0.1))]))
    follower = operations(
        vsr.Scene(ARM, [vsr.Tendon(PATH)], [vsr.TipWrench((0.0, 0.0, 0.1), frame="body")])
    )
    # a product of matrices counts once, also with six rows in place of three: those of the change
    # of the force, of its moment, and of the strain that it causes come to what dead loads have
    assert follower["small_product"] == dead["small_product"] + 3
    assert follower.total() > dead.total() + 75


def test_only_given_lengths_solve_for_tensions(plain):
    driven = operations(vsr.Scene(ARM, [vsr.Tendon(PATH, control="length")]))
    # the fixed-point steps of the start and the elimination of the tensions; no pass along the arm
    assert driven["scan"] == 2
    assert not any(driven[name] for name in ("sin", "cos", "cumsum", "lu"))


def test_only_friction_has_the_capstan(plain):
    rubbing = operations(vsr.Scene(ARM, [vsr.Tendon(PATH, friction=0.1)]))
    assert rubbing["exp"] > 0
    assert rubbing["scan"] > 0  # the running integral of the turning angle
    assert not any(rubbing[name] for name in ("sin", "cos", "lu"))


def test_free_strains_give_the_solve_their_size(plain):
    bending = operations(
        vsr.Scene(ARM, [vsr.Tendon(PATH)], free_strains=("bending_y", "bending_z"))
    )
    assert bending["div"] < plain["div"] - 15
    assert bending["sqrt"] <= plain["sqrt"] - 4


def test_only_constraints_can_be_loosened():
    def loosened(**around):
        scene = vsr.Scene(ARM, [vsr.Tendon(PATH)], [vsr.Gravity()], **around)
        return jax.eval_shape(lambda inputs: STEPS.solve(scene, inputs).loosened, jnp.zeros(1))

    assert loosened() is None
    assert loosened(held=vsr.Held(position=(0.3, 0.0, 0.0))) is not None


def test_an_end_costs_a_mask_only(plain):
    ended = operations(vsr.Scene(ARM, [vsr.Tendon(PATH, end=0.2)]))
    assert ended["while"] == plain["while"]
    assert ended["div"] == plain["div"] + 1  # the shares of the pieces in the steps
