"""Storage: checkpoints, exported parameters, the run log and the services that display it."""
