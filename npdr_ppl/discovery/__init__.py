"""Discovery: locate, name, add, prove."""

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Discovery
from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.investigation import Investigation, discover

__all__ = ["Discovery", "DiscoveryOptions", "Finding", "Investigation", "discover"]
