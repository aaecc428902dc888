"""Motion over time: inputs, steps, events, trajectories, and what is asked of them afterwards."""
