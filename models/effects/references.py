"""References for the catalogue's laws."""

__all__ = [
    "ARMSTRONG_1994",
    "ASTROM_1995",
    "ATKESON_1986",
    "BITTENCOURT_2012",
    "CANUDAS_1995",
    "DYNAMIXEL",
    "JANOT_2019",
    "LJUNG_1999",
    "MUJOCO",
    "SPONG_1987",
    "TAO_1996",
]

ARMSTRONG_1994 = (
    "B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, A survey of models, analysis tools and "
    "compensation methods for the control of machines with friction, Automatica, 1994"
)
ASTROM_1995 = (
    "K. J. Åström, T. Hägglund, PID controllers: theory, design, and tuning, second edition, "
    "1995, section 3.5"
)
ATKESON_1986 = (
    "C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of manipulator "
    "loads and links, The International Journal of Robotics Research, 1986"
)
CANUDAS_1995 = (
    "C. Canudas de Wit, H. Olsson, K. J. Åström, P. Lischinsky, A new model for control of "
    "systems with friction, IEEE Transactions on Automatic Control, 1995"
)
BITTENCOURT_2012 = (
    "A. C. Bittencourt, S. Gunnarsson, Static friction in a robot joint – modeling and "
    "identification of load and temperature effects, Journal of Dynamic Systems, Measurement, "
    "and Control, 2012"
)
JANOT_2019 = (
    "A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on "
    "Nonlinear System Identification Benchmarks, 2019"
)
SPONG_1987 = (
    "M. W. Spong, Modeling and control of elastic joint robots, Journal of Dynamic Systems, "
    "Measurement, and Control, 1987"
)
TAO_1996 = (
    "G. Tao, P. V. Kokotović, Adaptive control of systems with actuator and sensor "
    "nonlinearities, 1996"
)
LJUNG_1999 = "L. Ljung, System identification: theory for the user, second edition, 1999"
DYNAMIXEL = "Robotis, e-Manual of the X series: profiles and control of the goal"
MUJOCO = "MuJoCo's documentation, computation and modeling chapters"
