# syntax=docker/dockerfile:1
# The API and its dispatcher, without the engine: docker build -f docker/server.Dockerfile .
# Under 250 MB: what the base leaves of that is counted in tests/project/test_image_size.py.
FROM python:3.12.11-slim-bookworm AS build
RUN python -m venv --without-pip /opt/advtex
WORKDIR /src
COPY . .
# botocore describes every service of the cloud; here are the storage and what signs in to it.
RUN --mount=type=cache,target=/root/.cache/pip \
    pip --python /opt/advtex/bin/python install --constraint constraints.txt '.[server,traces]' \
    && find /opt/advtex/lib/python3.12/site-packages/botocore/data -mindepth 1 -maxdepth 1 -type d \
        ! -name s3 ! -name sts ! -name sso ! -name sso-oidc -exec rm -rf {} +
# What is installed, as CycloneDX: docker run --rm --entrypoint cat advtex-server /opt/advtex/sbom.json
RUN --mount=type=cache,target=/root/.cache/pip \
    python -m venv /opt/sbom \
    && /opt/sbom/bin/pip install --constraint constraints.txt cyclonedx-bom==7.5.0 \
    && /opt/sbom/bin/cyclonedx-py environment --output-file /opt/advtex/sbom.json /opt/advtex/bin/python

FROM python:3.12.11-slim-bookworm
RUN useradd --system --uid 10001 --home-dir /var/lib/advtex --create-home advtex
COPY --from=build /opt/advtex /opt/advtex
ENV PATH=/opt/advtex/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    ADVTEX_DATA_DIR=/var/lib/advtex
USER 10001
VOLUME /var/lib/advtex
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s --retries=3 \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/healthz', timeout=4)"]
ENTRYPOINT ["advtex-server"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
