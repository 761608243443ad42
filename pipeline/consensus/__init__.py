"""What a robot computes with its neighbours: common frame, corrected keyframes, matches. Arrays only, no messages."""
