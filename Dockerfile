# docker build -t ftl-lightning --build-arg TORCH_INDEX=<PyTorch's wheel index for CPU, or for a CUDA version> .
# docker run --rm -v "$PWD/logs:/app/logs" ftl-lightning fit --config conf/object_rearrangement.yaml
FROM python:3.11-slim

# Address of the index that torch's wheels come from (pytorch.org, "Get started", names one for CPU and one for each CUDA
# version). Empty: pip's own default.
ARG TORCH_INDEX=""
RUN apt-get update && apt-get install --yes --no-install-recommends g++ make && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home ftl && install --directory --owner ftl /app
USER ftl
WORKDIR /app
COPY --chown=ftl . .
RUN PIP_EXTRA_INDEX_URL=$TORCH_INDEX make install
ENV PATH=/app/.venv/bin:$PATH
ENTRYPOINT ["python", "-m", "ftl_lightning"]
CMD ["--help"]
