"""All settings, each defined once with its unit and default. Priority: defaults < file < command line."""
