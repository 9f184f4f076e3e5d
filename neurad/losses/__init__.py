"""The three terms of the objective (paper section 4), as functions of estimates."""
