"""The linear system of a step: normal equations, dense, block-sparse, or with variables eliminated."""
