"""The foundation of all other packages: errors, units, files, tables, warnings, kernels, code of users."""
