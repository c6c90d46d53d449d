//! A store in a folder that is thrown away, with versions made by hand.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use object_store::ObjectStore;
use object_store::local::LocalFileSystem;
use protocol::manifest::{ChunkRef, GarmentVersion, GenerationRef, RegionChunkRef, VersionStats};
use protocol::{ChunkHash, GarmentId, Manifest, SigningKey, StateId, VersionNumber, store};
use server::{Server, ServerConfig, Stats};

pub struct World {
    folder: tempfile::TempDir,
    key: SigningKey,
    versions: u64,
}

impl World {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self { folder, key: SigningKey::from_seed(&[3; 32]), versions: 0 }
    }

    pub fn path(&self, path: &str) -> PathBuf {
        let path = self.folder.path().join("store").join(path);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    pub fn config(&self) -> ServerConfig {
        self.config_with(Arc::new(self.store()))
    }

    pub fn store(&self) -> LocalFileSystem {
        std::fs::create_dir_all(self.folder.path().join("store")).unwrap();
        LocalFileSystem::new_with_prefix(self.folder.path().join("store")).unwrap()
    }

    /// The same world, by way of another store.
    pub fn config_with(&self, store: Arc<dyn ObjectStore>) -> ServerConfig {
        let any = "127.0.0.1:0".parse().unwrap();
        ServerConfig {
            http: Some(any),
            token: Some("letmein".into()),
            poll_interval: Duration::from_millis(20),
            telemetry_interval: Duration::from_millis(50),
            ..ServerConfig::new(store, any, self.folder.path().join("identity"))
        }
    }

    pub async fn serve(&self) -> Server {
        Server::start(self.config()).await.unwrap()
    }

    /// Stores a chunk of `bytes` bytes that begin with `name`.
    pub fn chunk(&self, name: u64, bytes: usize) -> ChunkRef {
        let mut content = vec![name as u8; bytes.max(8)];
        content[..8].copy_from_slice(&name.to_le_bytes());
        let hash = ChunkHash::of(&content);
        std::fs::write(self.path(&store::chunk_path(&hash)), &content).unwrap();
        ChunkRef { hash, bytes: content.len() as u32 }
    }

    pub fn manifest(&self, number: u64, regions: u64) -> Manifest {
        let region = |index: u64| RegionChunkRef {
            chunk: self.chunk(1000 + index, 3000 + 500 * index as usize % 20_000),
            first_state: StateId(index * 64),
            state_count: 64,
            initial: index == 0,
        };
        Manifest {
            number: VersionNumber(number),
            previous: (number > 1).then(|| ChunkHash::of(b"the one before")),
            garments: vec![GarmentVersion {
                id: GarmentId(0),
                name: "robe".into(),
                codec: "kim2013".into(),
                scene: self.chunk(1, 40_000),
                mesh: self.chunk(2, 9000),
                generations: vec![GenerationRef { chunk: self.chunk(3, 300_000), columns: 200 }],
                regions: (0..regions).map(region).collect(),
                links: vec![self.chunk(100_000 + number, 900)],
                stats: VersionStats {
                    poses: 30,
                    edges: 40,
                    states: 64 * regions,
                    worst_error_m: 0.01 / number as f32,
                    ..VersionStats::default()
                },
                upsampler: None,
            }],
        }
    }

    /// Publishes the next version, as the explorer does: chunks first, the manifest last, whole.
    pub fn publish(&mut self, regions: u64) -> Manifest {
        let manifest = self.manifest(self.versions + 1, regions);
        let bytes = manifest.clone().sign(&self.key).encode();
        self.put_version(&bytes);
        manifest
    }

    pub fn put_version(&mut self, bytes: &[u8]) {
        self.versions += 1;
        std::fs::write(self.path(store::PUBLISHER), format!("{}\n", self.key.public())).unwrap();
        let unfinished = self.folder.path().join("unfinished");
        std::fs::write(&unfinished, bytes).unwrap();
        let path = self.path(&store::version_path(VersionNumber(self.versions)));
        std::fs::rename(unfinished, path).unwrap();
    }
}

/// Waits until the server's figures are as they should be.
pub async fn until(server: &Server, what: &str, is_so: impl Fn(&Stats) -> bool) -> Stats {
    for _ in 0..1000 {
        let stats = server.stats();
        if is_so(&stats) {
            return stats;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("{what} did not come about: {:#?}", server.stats());
}
