"""What measures PLGS and is not it: baselines, experiments and benches. It imports the engine; nothing imports it."""
