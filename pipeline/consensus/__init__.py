"""What a robot computes with its neighbors: common frame, corrected keyframes, matches. Arrays only, no messages."""
