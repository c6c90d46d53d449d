//! TLS with a pinned certificate: the server's is self-signed, its fingerprint is its name.

use std::sync::{Arc, Mutex, PoisonError};

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{DigitallySignedStruct, SignatureScheme};
use sha2::{Digest, Sha256};

/// SHA-256 of a certificate (DER).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// 64 hexadecimal digits, in either case, with or without colons; `None` for anything else.
    pub fn parse(text: &str) -> Option<Self> {
        let digits: Vec<u8> = text
            .trim()
            .chars()
            .filter(|c| *c != ':')
            .map(|c| c.to_digit(16).map(|digit| digit as u8))
            .collect::<Option<_>>()?;
        let (pairs, rest) = digits.as_chunks::<2>();
        if !rest.is_empty() {
            return None;
        }
        let bytes: Vec<u8> = pairs.iter().map(|[high, low]| 16 * high + low).collect();
        bytes.try_into().ok().map(Self)
    }

    /// That of a certificate.
    pub fn of(certificate: &CertificateDer<'_>) -> Self {
        Self(Sha256::digest(certificate.as_ref()).into())
    }
}

impl std::fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// Accepts one certificate: the pinned one, or the first that is shown.
#[derive(Debug)]
pub struct Pin {
    provider: Arc<CryptoProvider>,
    state: Mutex<PinState>,
}

#[derive(Debug, Default)]
struct PinState {
    expected: Option<Fingerprint>,
    mismatch: Option<Fingerprint>,
}

impl Pin {
    /// `None` trusts the first certificate.
    pub fn new(expected: Option<Fingerprint>, provider: Arc<CryptoProvider>) -> Self {
        Self { provider, state: Mutex::new(PinState { expected, mismatch: None }) }
    }

    /// The sentence for people, if another certificate than the pinned one was shown.
    pub fn mismatch(&self) -> Option<String> {
        let state = self.lock();
        let (expected, found) = (state.expected?, state.mismatch?);
        Some(format!(
            "the server's certificate has the fingerprint {found}, but {expected} is pinned; is \
             it the right server? If its certificate was made anew, pin the new fingerprint"
        ))
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, PinState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerCertVerifier for Pin {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let found = Fingerprint::of(end_entity);
        let mut state = self.lock();
        if *state.expected.get_or_insert(found) == found {
            return Ok(ServerCertVerified::assertion());
        }
        state.mismatch = Some(found);
        Err(rustls::CertificateError::ApplicationVerificationFailure.into())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Err(rustls::PeerIncompatible::ServerTlsVersionIsDisabledByOurConfig.into())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls13_signature(message, certificate, signature, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_are_read_as_people_write_them() {
        let fingerprint = Fingerprint::of(&CertificateDer::from(vec![1, 2, 3]));
        let hex = fingerprint.to_string();
        assert_eq!(hex.len(), 64);
        assert_eq!(Fingerprint::parse(&hex), Some(fingerprint));
        let bytes: Vec<String> =
            hex.as_bytes().chunks(2).map(|b| String::from_utf8_lossy(b).to_uppercase()).collect();
        assert_eq!(Fingerprint::parse(&bytes.join(":")), Some(fingerprint));
        for wrong in ["", "ab", &hex[1..], &format!("{hex}00"), &hex.replace('a', "g")[..63]] {
            assert_eq!(Fingerprint::parse(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn another_certificate_than_the_first_is_refused_with_both_names() {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let (one, two) = (CertificateDer::from(vec![1]), CertificateDer::from(vec![2]));
        let pin = Pin::new(None, provider);
        let name = ServerName::try_from("toile").unwrap();
        let show = |c| pin.verify_server_cert(c, &[], &name, &[], UnixTime::now());
        assert!(show(&one).is_ok() && show(&one).is_ok());
        assert_eq!(pin.mismatch(), None);
        assert!(show(&two).is_err());
        let sentence = pin.mismatch().unwrap();
        assert!(sentence.contains(&Fingerprint::of(&one).to_string()), "{sentence}");
        assert!(sentence.contains(&Fingerprint::of(&two).to_string()), "{sentence}");
    }
}
