"""PyBullet as a simulator: scenes from URDF files or code, one simulation at a time on workers.

May import: engines.common, engines.pooled, language. Start reading at ``simulator.py``.
"""

from npdr_ppl.engines.bullet.channels import Command, Sensor
from npdr_ppl.engines.bullet.scene import Builder, Scene, Urdf
from npdr_ppl.engines.bullet.settings import BulletSettings
from npdr_ppl.engines.bullet.simulator import BulletSimulator

__all__ = ["Builder", "BulletSettings", "BulletSimulator", "Command", "Scene", "Sensor", "Urdf"]
