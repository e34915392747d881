"""Discovery: find where a model and a recording disagree, name the missing effect, prove it.

``screening`` asks whether anything is missing and which candidates explain it, ``search`` adds
effects one by one, ``proof`` measures what that gained on held-out data. May import: preparation,
models, engines. Start reading at ``investigation.py``.
"""

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Discovery
from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.investigation import Investigation, discover

__all__ = ["Discovery", "DiscoveryOptions", "Finding", "Investigation", "discover"]
