// One HTTP/1.1 connection to a gateway, plain or by TLS with a pinned key: requests without a body, answers with a stated length.
using System;
using System.Collections.Generic;
using System.IO;
using System.Net.Security;
using System.Security.Authentication;
using System.Security.Cryptography.X509Certificates;
using System.Text;

namespace IrisSession.Transport
{
    /// <summary>Status and headers of an answer.</summary>
    internal sealed class HttpHead
    {
        /// <summary>Most bytes and headers of a head.</summary>
        public const int MaxBytes = 16 << 10;
        private const int MaxHeaders = 100;

        private readonly Dictionary<string, string> headers = new Dictionary<string, string>(StringComparer.OrdinalIgnoreCase);

        public int Status { get; private set; }

        /// <summary>Return a header, empty where there is none.</summary>
        public string this[string name] { get { return headers.TryGetValue(name, out string value) ? value : ""; } }

        /// <summary>Bytes of the body; -1: it is not stated.</summary>
        public long ContentLength
        {
            get
            {
                string text = this["Content-Length"];
                return text.Length > 0 && text.Length < 16 && this["Transfer-Encoding"].Length == 0 && long.TryParse(text, out long length) && length >= 0 ? length : -1;
            }
        }

        /// <summary>Read the head at the beginning of `bytes`. Returns null while it is not complete; `length`: its bytes.</summary>
        /// <exception cref="TransportException">It is none.</exception>
        public static HttpHead TryRead(byte[] bytes, int count, out int length)
        {
            length = 0;
            for (int i = 3; i < count && length == 0; i++)
            {
                if (bytes[i] == '\n' && bytes[i - 1] == '\r' && bytes[i - 2] == '\n' && bytes[i - 3] == '\r') length = i + 1;
            }
            if (length == 0)
            {
                if (count >= MaxBytes) throw new TransportException(LinkFailure.NotAGateway, "an answer whose head has more than " + MaxBytes + " bytes");
                return null;
            }
            string[] lines = Encoding.ASCII.GetString(bytes, 0, length - 4).Split(new[] { "\r\n" }, StringSplitOptions.None);
            HttpHead head = new HttpHead();
            string first = lines[0];
            bool isAnswer = first.StartsWith("HTTP/1.1 ", StringComparison.Ordinal) && first.Length >= 12 && int.TryParse(first.Substring(9, 3), out _);
            if (!isAnswer || lines.Length > MaxHeaders) throw new TransportException(LinkFailure.NotAGateway, "an answer that is not HTTP/1.1");
            head.Status = int.Parse(first.Substring(9, 3));
            for (int i = 1; i < lines.Length; i++)
            {
                int colon = lines[i].IndexOf(':');
                if (colon <= 0) throw new TransportException(LinkFailure.NotAGateway, "an answer with a header without a name");
                head.headers[lines[i].Substring(0, colon).Trim()] = lines[i].Substring(colon + 1).Trim();
            }
            return head;
        }
    }

    /// <summary>A connection. For one thread, but for writing and reading of what is no HTTP any more. See <see cref="InterruptibleStream"/>.</summary>
    internal sealed class HttpConnection : IDisposable
    {
        /// <summary>Time for the connection, TLS and a first answer: a slow link needs three round trips of a second.</summary>
        private const long SetupNs = 8_000_000_000;

        private readonly InterruptibleStream stream;
        private readonly SslStream tls;
        private readonly Stream top;
        private readonly WebEndpoint endpoint;
        private byte[] shown; // hash of the key of the certificate
        private string fingerprint = "";

        // Bytes that were received and not used yet.
        private readonly byte[] buffer = new byte[HttpHead.MaxBytes];
        private int begin;
        private int end;

        /// <summary>Connect, and check the key of the other end.</summary>
        /// <param name="endpoint">With a pin, unless `takesAnyKey`.</param>
        /// <param name="interrupt">Ends all waits.</param>
        /// <param name="takesAnyKey">For pairing, which proves the key by the code: see `CertificateHash`.</param>
        /// <exception cref="TransportException">There is no connection.</exception>
        public HttpConnection(WebEndpoint endpoint, Interrupt interrupt, bool takesAnyKey = false)
        {
            this.endpoint = endpoint;
            stream = InterruptibleStream.Connect(endpoint.Host, endpoint.Port, MonotonicClock.NowNs + SetupNs, interrupt);
            top = stream;
            if (!endpoint.IsSecure) return;
            try
            {
                tls = new SslStream(stream, true, (sender, certificate, chain, errors) => CheckKey(certificate, takesAnyKey));
                tls.AuthenticateAsClient(endpoint.Host, null, SslProtocols.Tls12, false);
                // A runtime that does not ask `CheckKey` must not be a way around the pin.
                if (!IsRightKey(takesAnyKey)) throw new AuthenticationException("the key of the other end was not checked");
                top = tls;
            }
            catch (Exception error) when (IsOfConnection(error))
            {
                Dispose();
                throw ToLinkException(error, interrupt);
            }
        }

        /// <summary>Hash of the key that the other end has proved to have, null without TLS.</summary>
        public byte[] CertificateHash { get { return shown; } }

        /// <summary>Send the head of a request.</summary>
        /// <param name="path">Path of a GET.</param>
        /// <param name="headers">Further lines, each with its end.</param>
        public void SendRequest(string path, string headers)
        {
            byte[] bytes = Encoding.ASCII.GetBytes("GET " + path + " HTTP/1.1\r\nHost: " + endpoint.Authority + "\r\n" + headers + "\r\n");
            top.Write(bytes, 0, bytes.Length);
            top.Flush();
        }

        /// <summary>Wait for the head of the next answer.</summary>
        public HttpHead ReadHead()
        {
            while (true)
            {
                if (begin > 0) Buffer.BlockCopy(buffer, begin, buffer, 0, end - begin);
                end -= begin;
                begin = 0;
                HttpHead head = HttpHead.TryRead(buffer, end, out int length);
                if (head != null)
                {
                    begin = length;
                    return head;
                }
                int got = top.Read(buffer, end, buffer.Length - end);
                if (got == 0) throw new TransportException(LinkFailure.Unreachable, "the connection was closed before an answer");
                end += got;
            }
        }

        /// <summary>Wait for `count` bytes of a body.</summary>
        public void ReadBody(byte[] target, int count)
        {
            int at = 0;
            while (at < count)
            {
                int got = Read(target, at, count - at);
                if (got == 0) throw new TransportException(LinkFailure.Unreachable, "the connection was closed within an answer");
                at += got;
            }
        }

        /// <summary>Wait for a body of text, of which at most `most` bytes are kept.</summary>
        public string ReadText(HttpHead head, int most)
        {
            long left = head.ContentLength;
            if (left < 0 || left > 1 << 20) throw new TransportException(LinkFailure.NotAGateway, "an answer without a length");
            byte[] bytes = new byte[left];
            ReadBody(bytes, (int)left);
            return Encoding.UTF8.GetString(bytes, 0, (int)Math.Min(left, most)).Trim();
        }

        /// <summary>Wait for bytes, whatever they are. 0: the other end has closed.</summary>
        public int Read(byte[] target, int offset, int count)
        {
            if (begin == end) return top.Read(target, offset, count);
            int some = Math.Min(count, end - begin);
            Buffer.BlockCopy(buffer, begin, target, offset, some);
            begin += some;
            return some;
        }

        public void Write(byte[] bytes, int count)
        {
            top.Write(bytes, 0, count);
            top.Flush();
        }

        /// <summary>Set when reads and writes fail [ns of the monotonic clock].</summary>
        public void SetDeadline(long deadlineNs)
        {
            stream.DeadlineNs = deadlineNs;
        }

        /// <summary>End waits of the other thread.</summary>
        public void Shutdown()
        {
            stream.Shutdown();
        }

        public void Dispose()
        {
            try
            {
                tls?.Dispose();
            }
            catch (Exception error) when (IsOfConnection(error))
            {
                // its farewell cannot be sent any more
            }
            stream.Dispose();
        }

        /// <summary>Return whether an exception is one of sockets, TLS or HTTP, of this runtime or another.</summary>
        public static bool IsOfConnection(Exception error)
        {
            return error is TransportException || error is IOException || error is AuthenticationException || error is ObjectDisposedException
                || error is System.Net.Sockets.SocketException || error is InvalidOperationException || error is NotSupportedException
                || error is AggregateException || error is System.Security.Cryptography.CryptographicException;
        }

        /// <summary>Return what happened, in one of our words.</summary>
        public TransportException ToLinkException(Exception error, Interrupt interrupt)
        {
            if (interrupt.IsSet) return new TransportException(LinkFailure.None, "the connection was closed");
            for (Exception inner = error; inner != null; inner = inner.InnerException) if (inner is TransportException known) return known;
            if (endpoint.IsSecure && shown != null && !Transport.CertificateHash.AreEqual(shown, endpoint.Pin))
            {
                return endpoint.Pin == null
                    ? new TransportException(LinkFailure.UnknownCertificate, "the key of " + endpoint.Authority + " is not known yet", 0, shown, fingerprint)
                    : new TransportException(LinkFailure.WrongCertificate, endpoint.Authority + " has another key than before", 0, shown, fingerprint);
            }
            if (endpoint.IsSecure && top == stream) return new TransportException(LinkFailure.NotAGateway, "no TLS with " + endpoint.Authority + ": " + error.Message);
            return new TransportException(LinkFailure.Unreachable, error.Message);
        }

        private bool CheckKey(X509Certificate certificate, bool takesAnyKey)
        {
            if (certificate == null) return false;
            byte[] der = certificate.GetRawCertData();
            shown = Transport.CertificateHash.Compute(der);
            fingerprint = Core.Fingerprint.OfCertificate(der);
            return IsRightKey(takesAnyKey);
        }

        private bool IsRightKey(bool takesAnyKey)
        {
            return takesAnyKey ? shown != null : Transport.CertificateHash.AreEqual(shown, endpoint.Pin);
        }
    }
}
