# syntax=docker/dockerfile:1
FROM python:3.11-slim-bookworm AS build

ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/lensmatch
ENV PATH=/opt/lensmatch/bin:$PATH

# The libraries first: they change less often than the product, and this layer is kept as long as they do not.
COPY constraints/runtime.txt /build/constraints/runtime.txt
RUN python -m pip install --require-hashes --only-binary :all: -r /build/constraints/runtime.txt

WORKDIR /build
COPY pyproject.toml README.md LICENSE ./
COPY app app
COPY benchmarks benchmarks
COPY calibration calibration
COPY engine_adapters engine_adapters
COPY storage storage
RUN python -m pip install --no-deps --no-build-isolation .


FROM python:3.11-slim-bookworm

LABEL org.opencontainers.image.title="lensmatch" \
      org.opencontainers.image.licenses="MIT"

RUN useradd --create-home --uid 10001 lensmatch && install -d -o lensmatch -g lensmatch /data
COPY --from=build /opt/lensmatch /opt/lensmatch
ENV PATH=/opt/lensmatch/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    LENSMATCH_DATABASE=/data/lensmatch.db

USER lensmatch
WORKDIR /data
VOLUME ["/data"]
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=15s --timeout=5s --start-period=20s --retries=3 \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/api/v1/healthz', timeout=4).read()"]

# No shell in between: signals reach the service.
ENTRYPOINT ["lensmatch"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
