"""Discovery: locate, name, add, prove."""

from npdr_ppl.workflows.discovery.discovery import Investigation, discover
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.result import Discovery, Finding

__all__ = ["Discovery", "DiscoveryOptions", "Finding", "Investigation", "discover"]
