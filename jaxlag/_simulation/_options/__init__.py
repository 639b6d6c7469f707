"""Options of `simulate`: checks, requirements of methods, options that others pass on."""
