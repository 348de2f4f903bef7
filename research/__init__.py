"""Measure PLGS from outside: baselines, experiments and benches. It imports the engine; nothing imports it."""
