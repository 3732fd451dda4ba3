"""C for controllers: templates that read top to bottom, tables of the model, the law emitted."""
