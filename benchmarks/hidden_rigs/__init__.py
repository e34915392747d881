"""Hidden rigs: recordings of rigs that the package has no model of, for discovery to explain."""
