"""What a search on an arm of seven joints leaves behind: long names, many rows, long ranges."""

import json
import math

JOINTS = [f"joint_{k}" for k in range(1, 8)]
CHANNELS = [*JOINTS, *(f"{joint}_velocity" for joint in JOINTS)]
MOTORS = [f"motor_{joint}" for joint in JOINTS]


def write_arm_discovery(folder):
    """Writes ``discovery.json``, ``overlays.json`` and ``revised_model.py``."""
    folder.mkdir()
    effects = [_effect("actuator_gain", motor, "error", -0.05 * (k + 1), "1", 0.5 / (k + 1))
               for k, motor in enumerate(MOTORS)]  # fmt: skip
    lag = "joint_6,joint_6_velocity"
    effects.append(_effect("sensor_low_pass", lag, "time_constant", 0.0028, "s", 0.01))
    every = ",".join(CHANNELS)
    effects.append(_effect("sensor_delay", every, "delay", 0.0012, "s", 0.005))
    effects.append(_effect("presliding_friction", "joint_7_torque", "magnitude", 0.1, "N m", 0.01))
    region = ", ".join(f"{name} -0.163 to 0.142" for name in (*CHANNELS, *MOTORS))
    where = [
        {"rollout": 0, "time_span": [k, k + 0.2], "channel": "joint_7_velocity",
         "region": region, "z": 42.0 - k}
        for k in range(10)
    ]  # fmt: skip
    names = " and ".join(f"{e['port']}.{e['effect']}" for e in effects)
    found = {
        "stage": "prove", "verdict": "unknown", "has_stopped": True,
        "reason": f"The time limit of 900 s ended the search. The best explanation so far is "
                  f"{names}; not all alternatives to it were tried.",
        "alarm": {"p_value": 7.51e-08, "fired": True},
        "remainder": {"p_value": 3.49e-18, "fired": True, "unexplained": 0.02},
        "where": where, "effects": effects,
        "ranking": [{**e, "separation": 9.0 * (k + 1)} for k, e in enumerate(effects)],
        "gap": {
            "rmse": {"before": 0.013, "after": 0.007, "noise_floor": 0.006, "closed": 0.87},
            "dtw": {"before": 657.0, "after": 320.0, "noise_floor": 272.0, "closed": 0.87},
            "coverage": {"before": 0.957, "after": 0.958, "noise_floor": None, "closed": None},
        },
        "next_experiment": {
            "excitation": "steps", "separations": {"slow_ramp": 1.5, "steps": 235.6, "hold": None},
            "amplitude": dict.fromkeys(MOTORS, 0.784), "separated_by": "",
        },
        "parameters": {f"damping_{j}": _interval(0.8, "N m s/rad") for j in JOINTS},
        "seconds": {"search": 900.0},
        "model": {"name": "arm", "source": "def arm(inputs):\n" + 40 * f"    x = {region!r}\n"},
    }  # fmt: skip
    (folder / "discovery.json").write_text(json.dumps(found))
    (folder / "overlays.json").write_text(json.dumps(_overlays()))
    (folder / "revised_model.py").write_text("def revised_model(inputs):\n    pass\n")


def _effect(name, port, parameter, mean, unit, share):
    return {
        "effect": name, "port": port, "probability": 1.0, "share": share,
        "equivalent_to": ["payload", "everything scaled", "servo_gain", "tilt", "unbalance"],
        "alternatives": {f"{port}.{name}": 0.9, "payload.payload": 0.1},
        "parameters": {parameter: _interval(mean, unit)},
        "parts": [{"part": part, "strengths": {parameter: {"mean": mean, "sd": 0.004}}}
                  for part in ("the first half", "the second half")],
    }  # fmt: skip


def _interval(mean, unit):
    return {"mean": mean, "sd": 0.0035, "hdi_94": [mean - 0.006, mean + 0.006], "unit": unit}


def _overlays():
    time = [0.01 * k for k in range(300)]
    channels = {}
    for k, channel in enumerate(CHANNELS):
        measured = [math.sin((1 + 0.3 * k) * t) for t in time]
        channels[channel] = {
            "measured": measured,
            # The nominal model runs away and then fails.
            "nominal": [v * math.exp(2 * t) if t < 2 else None
                        for v, t in zip(measured, time, strict=True)],
            "fitted": [1.1 * v + 0.05 for v in measured],
            "revised": [1.01 * v for v in measured],
            "fitted_error": [0.1 * v + 0.05 for v in measured],
            "revised_error": [0.01 * v for v in measured],
        }  # fmt: skip
    misfit = {name: dict.fromkeys(CHANNELS, e) for name, e in (("fitted", 0.1), ("revised", 0.01))}
    rollouts = [{"rollout": k, "time": time, "channels": channels, "misfit": misfit}
                for k in range(2)]  # fmt: skip
    before = [[float(k + cell) for cell in range(40)] for k in range(len(CHANNELS))]
    after = [[1.0] * 40 for _ in CHANNELS]
    return {
        "is_held_out": True, "restart_seconds": 2.0, "channels": CHANNELS,
        "units": {c: "rad/s" if "velocity" in c else "rad" for c in CHANNELS},
        "rollouts": rollouts,
        "maps": [{"rollout": k, "seconds": 8.0, "before": before, "after": after}
                 for k in range(2)],
    }  # fmt: skip
