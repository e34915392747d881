"""Policies and policy search, one file each."""
