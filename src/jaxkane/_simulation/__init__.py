"""Motion over time: inputs, steps, events, trajectories, and what can be told of them afterwards."""
