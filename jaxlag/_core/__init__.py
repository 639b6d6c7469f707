"""What every other package stands on: errors, arrays, batching, maps with derivatives."""
