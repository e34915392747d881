"""The language: channels, simulators, black-box sample sites, priors and effects."""
