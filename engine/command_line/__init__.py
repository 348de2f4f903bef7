"""The engine as a command: ``python -m engine lift|evaluate|inspect``. Heavy libraries load when they are used."""
