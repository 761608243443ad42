"""Agents that exchange packets over simulated radio links: loop closing, alignment, sharing, sessions, replay.

An agent knows its own log, its own front end's outputs, its configuration and the packets that reached it. Nothing
else may be imported here: no ground truth, no other robot's files. The protocol: `docs/explanation/exchange.md`.
"""
