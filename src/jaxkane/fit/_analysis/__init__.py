"""What has to be computed after a fit, or before one: suspicions, evidence, the design of an experiment."""
