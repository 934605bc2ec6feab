"""Replays recorded human-robot sessions through a safety-aware trajectory generator."""

__version__ = "0.1.0"
