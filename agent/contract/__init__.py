"""What the runtime and the designer share: files, messages, draws. Leaf modules; no network, no processes."""
