"""What measures the project itself: benchmarks, speed against accuracy, numerical extremes."""
