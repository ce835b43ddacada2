"""PID controllers against MuJoCo C: subsets of the inputs, slewing, wind-up, angles."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.forces.acting import within
from tests.forces.actuated import errors, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY

GENERAL = '<general gaintype="pid" biastype="affine" biasprm="0.3 -2 -1" '
CONTROLLERS = {
    "joints": [
        '<pid joint="h" kp="3" kv="0.5"/>',
        '<pid joint="s" kp="3" ki="0.7" imax="0.11" slewmax="2" input="pos vel ff"'
        ' posrange="-1 1" velrange="-2 2" ffrange="-.3 .3" forcerange="-3 4"/>',
        '<pid joint="k" kp="3" kv="0.5" ki="0.7" input="pos ff"/>',
        '<pid joint="k" kp="3" kv="0.5" slewmax="7" input="pos"/>',
        '<pid tendon="band" kv="0.5" input="vel"/>',
        f'{GENERAL} dyntype="pid" dynprm="0.2 3" gainprm="0.3" joint="h" actdim="2"'
        ' actrange="-0.1 0.2" actearly="true"/>',
    ],
    "angles": [
        '<pid joint="b" kp="3" kv="0.5" input="pos"/>',
        '<pid joint="b" gear="0.2 0.3 0.1" kp="3" ki="0.7" imax="0.1" slewmax="99" input="pos"/>',
        '<pid site="s4" refsite="s1" gear="0 0 0 0.2 0.3 0.1" kp="3" ki="0.7" slewmax="9"/>',
        '<pid site="s4" refsite="s2" gear="0 1 0 0.2 0.3 0.1" kp="3" ki="0.7" slewmax="9"/>',
    ],
}


@pytest.mark.parametrize("which", CONTROLLERS)
def test_against_mujoco(which):
    assert max(errors(limbs(*CONTROLLERS[which]))) < F64_PARITY


def test_states_within_their_ranges():
    """Of the first the file says none: its integral is only no longer added to at the limit."""
    _, free, *_, ranged = CONTROLLERS["joints"]
    x = within(load_quietly(limbs(free, ranged)), jnp.array([0.4, 5.0, 0.05, 5.0]))
    np.testing.assert_array_equal(x, [0.4, 5.0, 0.05, 0.2])
