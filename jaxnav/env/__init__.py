"""One episode: reset, step and observe; batching, metrics, contract checks and adapters."""
