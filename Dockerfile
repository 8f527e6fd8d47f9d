# docker build -t ftl-lightning --build-arg TORCH_INDEX=<PyTorch's wheel index for CPU, or for a CUDA version> .
# docker run --rm -v "$PWD/logs:/app/logs" ftl-lightning fit --config conf/object_rearrangement.yaml

# A tag, not a digest: a digest names one build for one kind of processor, and gets no security updates. To pin one:
# --build-arg BASE=python:3.11-slim@sha256:...
ARG BASE=python:3.11-slim
FROM ${BASE}

# Address of the one index that torch comes from (pytorch.org, "Get started", names one for CPU and one for each CUDA version).
# Empty: pip's own default. Everything else comes from pip's default index, and its files have the hashes of requirements.lock.
ARG TORCH_INDEX=""
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home ftl && install --directory --owner ftl /app
USER ftl
WORKDIR /app
ENV PATH=/app/.venv/bin:$PATH
COPY --chown=ftl constraints.txt requirements.lock ./
RUN python -m venv .venv \
    && pip install --no-cache-dir --constraint constraints.txt ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch \
    && pip install --no-cache-dir --require-hashes --no-deps --requirement requirements.lock
COPY --chown=ftl . .
RUN pip install --no-cache-dir --no-deps --no-build-isolation .
ENTRYPOINT ["python", "-m", "ftl_lightning"]
CMD ["--help"]
