"""The engine's command line: ``python -m engine lift|evaluate|inspect`` and more. Heavy libraries load on first use."""
