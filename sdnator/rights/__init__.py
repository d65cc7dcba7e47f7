"""Identities of apps and what each may publish and observe."""
