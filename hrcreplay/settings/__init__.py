"""All settings, each defined once with its unit and default. Defaults < file < command line."""
