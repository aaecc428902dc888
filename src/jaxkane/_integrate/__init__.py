"""Simulation: inputs, steps, events, trajectories, and quantities computed from trajectories."""
