# syntax=docker/dockerfile:1
# A worker with the engine: docker build -f docker/worker.Dockerfile .
#
# The base is plain Python: PyTorch's wheel brings the CUDA libraries that it was built with, so a CUDA base image would
# only hold them twice. The host needs NVIDIA's container toolkit and a driver for CUDA 13 (580 or newer). Without a GPU
# the same image uses the CPU.
FROM python:3.12.11-slim-bookworm AS build
RUN python -m venv /opt/advtex
WORKDIR /src
# The large wheels first: a change of the code does not fetch them again.
COPY constraints.txt .
RUN --mount=type=cache,target=/root/.cache/pip \
    /opt/advtex/bin/pip install --constraint constraints.txt torch numpy opencv-python-headless av imagecodecs
COPY . .
RUN --mount=type=cache,target=/root/.cache/pip \
    /opt/advtex/bin/pip install --constraint constraints.txt '.[worker,draco,traces]'
# What is installed, as CycloneDX: docker run --rm --entrypoint cat advtex-worker /opt/advtex/sbom.json
RUN --mount=type=cache,target=/root/.cache/pip \
    python -m venv /opt/sbom \
    && /opt/sbom/bin/pip install --constraint constraints.txt cyclonedx-bom==7.5.0 \
    && /opt/sbom/bin/cyclonedx-py environment --output-file /opt/advtex/sbom.json /opt/advtex/bin/python

FROM python:3.12.11-slim-bookworm
# Triton compiles what launches its kernels; versions are the base image's.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
RUN useradd --system --uid 10001 --home-dir /var/lib/advtex --create-home advtex
COPY --from=build /opt/advtex /opt/advtex
ENV PATH=/opt/advtex/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    ADVTEX_DATA_DIR=/var/lib/advtex
USER 10001
VOLUME /var/lib/advtex
# Healthy as long as a worker of this host announces itself.
HEALTHCHECK --interval=30s --timeout=10s --start-period=30s --retries=3 \
    CMD ["python", "-c", "import socket, sys; from advtex_store.queue import JobQueue, connect_redis; from advtex_store.settings import StoreSettings; sys.exit(not JobQueue(connect_redis(StoreSettings())).workers(socket.gethostname()))"]
ENTRYPOINT ["advtex-worker"]
