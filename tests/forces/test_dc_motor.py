"""DC motors against MuJoCo C: current, heat, cogging, friction, the controller on board."""

from tests.forces.actuated import errors, limbs
from tests.tolerances import F64_PARITY

K = 'motorconst="0.5 0.6" resistance="2"'
HOT, COIL = 'thermal="2 3 0 0.04 25 20"', 'inductance="0.3 0"'
BEARING = 'lugre="30 0.2 0.3 0.4 0.1" cogging="0.1 4 0.3"'
MOTORS = [
    f'<dcmotor joint="h" {K}/>',
    f'<dcmotor joint="h" {K} input="none" {BEARING}/>',
    f'<dcmotor joint="s" {K} input="pos vel" controller="1.1 0.2 0.3 5 0.15 12"/>',
    f'<dcmotor joint="s" {K} input="vel ff" controller="1.1 0 0.3 5 0 1"/>',
    f'<dcmotor joint="k" {K} {COIL} saturation="0.11 0 10"/>',
    f'<dcmotor joint="k" {K} {HOT}/>',
    f'<dcmotor joint="b" gear="1 2 3" {K} {HOT} input="pos" controller="1 0.2 0.3 0 0 0"/>',
    f'<dcmotor tendon="rope" {K} {HOT} {COIL} {BEARING} saturation="1.1 0 40"'
    ' input="pos vel ff voltage" controller="1.1 0.2 0.3 5 0.15 12"/>',
    f'<dcmotor tendon="band" motorconst="0 0" resistance="1" {COIL} input="none"/>',
]


def test_against_mujoco():
    assert max(errors(limbs(*MOTORS))) < F64_PARITY
