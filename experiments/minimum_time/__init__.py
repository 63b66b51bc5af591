"""Minimum-time tasks under several time limits: how they are learnt, and what the initial policy foretells of it."""
