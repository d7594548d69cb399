"""An analysis and how far it can be trusted: residuals, influence, responses, checks."""
