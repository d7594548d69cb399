"""From data to a first configuration (``en4dvar init``): what the data show, first guesses, a commented YAML file."""
