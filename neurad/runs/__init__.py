"""Configs, run folders, child processes and the Lightning command line."""
