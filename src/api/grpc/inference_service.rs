//! `inference.GRPCInferenceService` of the Open Inference Protocol, version 2: each network of the
//! bundle as a model.

use tonic::{Request, Response};

use super::{
    pb_inference::{
        InferTensorContents, ModelInferRequest, ModelInferResponse, ModelMetadataRequest,
        ModelMetadataResponse, ModelReadyRequest, ModelReadyResponse, ServerLiveRequest,
        ServerLiveResponse, ServerMetadataRequest, ServerMetadataResponse, ServerReadyRequest,
        ServerReadyResponse, grpc_inference_service_server::GrpcInferenceService,
        model_infer_request::InferInputTensor, model_infer_response::InferOutputTensor,
        model_metadata_response::TensorMetadata,
    },
    scene_service::{Answer, answer, held, weighed},
};
use crate::{
    api::{
        Api,
        inference::{
            EXTENSIONS, PLATFORM, SERVER, datatype, kind_of, of_bytes, shape_of, to_bytes,
        },
    },
    error::{Error, ErrorCode, Result, short},
    models::{Tensor, TensorData, TensorKind, TensorSpec},
    service::InferSpec,
};

#[tonic::async_trait]
impl GrpcInferenceService for Api {
    async fn server_live(&self, _: Request<ServerLiveRequest>) -> Answer<ServerLiveResponse> {
        Ok(Response::new(ServerLiveResponse { live: true }))
    }

    async fn server_ready(&self, _: Request<ServerReadyRequest>) -> Answer<ServerReadyResponse> {
        Ok(Response::new(ServerReadyResponse { ready: self.networks_ready() }))
    }

    async fn server_metadata(
        &self,
        _: Request<ServerMetadataRequest>,
    ) -> Answer<ServerMetadataResponse> {
        let (name, version) = (SERVER.to_owned(), env!("CARGO_PKG_VERSION").to_owned());
        let extensions = EXTENSIONS.map(str::to_owned).to_vec();
        Ok(Response::new(ServerMetadataResponse { name, version, extensions }))
    }

    async fn model_ready(&self, request: Request<ModelReadyRequest>) -> Answer<ModelReadyResponse> {
        answer(self, request, |api, asked| async move {
            no_version(&asked.version)?;
            Ok(ModelReadyResponse { ready: api.service.network_ready(&asked.name)? })
        })
        .await
    }

    async fn model_metadata(
        &self,
        request: Request<ModelMetadataRequest>,
    ) -> Answer<ModelMetadataResponse> {
        answer(self, request, |api, asked| async move {
            no_version(&asked.version)?;
            let tensors = api.service.network_tensors(&asked.name).await?;
            let all = |specs: Vec<TensorSpec>| specs.into_iter().map(metadata).collect();
            Ok(ModelMetadataResponse {
                name: asked.name,
                platform: PLATFORM.to_owned(),
                inputs: all(tensors.inputs),
                outputs: all(tensors.outputs),
                ..ModelMetadataResponse::default()
            })
        })
        .await
    }

    async fn model_infer(&self, request: Request<ModelInferRequest>) -> Answer<ModelInferResponse> {
        answer(self, request, |api, asked| async move {
            no_version(&asked.model_version)?;
            let (model_name, id) = (asked.model_name.clone(), asked.id.clone());
            let found = api.service.infer(spec(asked)?).await?;
            let raw_output_contents = found.iter().map(|one| to_bytes(&one.data).into()).collect();
            let outputs = found.into_iter().map(output).collect();
            let told = ModelInferResponse { model_name, id, outputs, ..Default::default() };
            weighed(&api, ModelInferResponse { raw_output_contents, ..told })
        })
        .await
        .map(held)
    }
}

/// Networks have no versions: the bundle is the version.
fn no_version(version: &str) -> Result<()> {
    if version.is_empty() {
        return Ok(());
    }
    let why = format!("no version {:?}; networks have no versions", short(version));
    Err(Error::new(ErrorCode::NotFound, why))
}

fn metadata(TensorSpec { name, kind, shape, .. }: TensorSpec) -> TensorMetadata {
    TensorMetadata { name, datatype: datatype(kind).to_owned(), shape }
}

fn output(Tensor { name, shape, data }: Tensor) -> InferOutputTensor {
    let shape = shape.into_iter().map(|size| i64::try_from(size).unwrap_or(i64::MAX)).collect();
    let datatype = datatype(data.kind()).to_owned();
    InferOutputTensor { name, datatype, shape, ..InferOutputTensor::default() }
}

fn spec(asked: ModelInferRequest) -> Result<InferSpec> {
    let (inputs, raw) = (asked.inputs, asked.raw_input_contents);
    if !raw.is_empty() && raw.len() != inputs.len() {
        let (given, wanted) = (raw.len(), inputs.len());
        let why = format!("raw_input_contents has {given} tensors, and inputs has {wanted}");
        return Err(Error::invalid(why));
    }
    let mut raw = raw.into_iter();
    let tensor = |InferInputTensor { name, datatype, shape, contents, parameters }| {
        let what = format!("input {:?}", short(&name));
        if let Some(other) = parameters.keys().next() {
            let why = format!("{what} has the parameter {:?}, which is not known", short(other));
            return Err(Error::invalid(why));
        }
        let kind = kind_of(&what, &datatype)?;
        let data = match (raw.next(), contents) {
            (Some(bytes), None) => of_bytes(&what, kind, &bytes)?,
            (None, Some(contents)) => typed(kind, contents),
            (Some(_), Some(_)) => {
                let why = format!("{what} has both contents and raw_input_contents");
                return Err(Error::invalid(why));
            }
            (None, None) => return Err(Error::invalid(format!("{what} has no contents"))),
        };
        Ok(Tensor { shape: shape_of(&what, &shape)?, name, data })
    };
    Ok(InferSpec {
        network: asked.model_name,
        inputs: inputs.into_iter().map(tensor).collect::<Result<_>>()?,
        outputs: asked.outputs.into_iter().map(|output| output.name).collect(),
    })
}

/// Numbers of the list that belongs to the kind.
fn typed(kind: TensorKind, contents: InferTensorContents) -> TensorData {
    match kind {
        TensorKind::F32 => TensorData::F32(contents.fp32_contents),
        TensorKind::I64 => TensorData::I64(contents.int64_contents),
        // No network takes it, so its numbers do not matter.
        TensorKind::U8 => TensorData::U8(Vec::new()),
    }
}
