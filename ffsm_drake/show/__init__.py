"""What people look at: tables, figures, pages, recordings, block diagrams."""
