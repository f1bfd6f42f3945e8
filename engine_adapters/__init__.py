"""Everything that touches a wire: the R3 socket, the MockBoard, camera heads, folders of pictures, simulators."""
