"""Forward models: state and parameters, the interface, batches, functions and programs as models."""
