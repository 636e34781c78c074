"""The observer of the general class: one error system for what users type."""
