"""What a person looks at: colours of pictures, sheets of a view, charts, and pages that need no network."""
