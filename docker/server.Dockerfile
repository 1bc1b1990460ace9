# syntax=docker/dockerfile:1
# The API and its dispatcher, without the engine: docker build -f docker/server.Dockerfile .
FROM python:3.12.11-slim-bookworm AS build
RUN python -m venv /opt/advtex
WORKDIR /src
COPY . .
RUN --mount=type=cache,target=/root/.cache/pip \
    /opt/advtex/bin/pip install --constraint constraints.txt '.[server]'

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
