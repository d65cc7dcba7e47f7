import p4rt as p4rt  # before anything here loads gRPC: it says how gRPC waits
