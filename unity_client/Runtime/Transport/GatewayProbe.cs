// Asks `GET /v1/info` of a gateway, on a thread of its own: whether it answers, of which session, and by which key.
using System;
using System.Threading;

namespace IrisSession.Transport
{
    /// <summary>One question. Its thread ends by itself, at the latest when it is aborted.</summary>
    internal sealed class GatewayProbe
    {
        private const int MaxText = 4096;

        private readonly WebEndpoint endpoint;
        private readonly AutoResetEvent news;
        private readonly Interrupt interrupt = new Interrupt();
        private readonly Thread thread;
        private volatile bool hasEnded;

        /// <param name="endpoint">With a pin, if it has TLS.</param>
        /// <param name="news">Set when there is an answer; null: it is polled.</param>
        public GatewayProbe(WebEndpoint endpoint, AutoResetEvent news)
        {
            this.endpoint = endpoint;
            this.news = news;
            thread = new Thread(Run) { IsBackground = true, Name = "iris-session probe" };
        }

        public bool HasEnded { get { return hasEnded; } }

        /// <summary>The answer, once `HasEnded`.</summary>
        public ProbeAnswer Answer { get; private set; }

        public void Start()
        {
            thread.Start();
        }

        public void Abort()
        {
            interrupt.Set();
        }

        public bool Join(int milliseconds)
        {
            return thread.Join(milliseconds);
        }

        /// <summary>Return the text of a field of flat JSON whose text has no escapes; empty where there is none.</summary>
        public static string FindText(string json, string name)
        {
            int at = json.IndexOf("\"" + name + "\"", StringComparison.Ordinal);
            if (at < 0) return "";
            int begin = at + name.Length + 2;
            while (begin < json.Length && (json[begin] == ' ' || json[begin] == ':')) begin++;
            if (begin >= json.Length || json[begin] != '"') return "";
            int end = json.IndexOfAny(new[] { '"', '\\' }, begin + 1);
            return end < 0 || json[end] == '\\' ? "" : json.Substring(begin + 1, end - begin - 1);
        }

        private void Run()
        {
            LinkEnd end = default;
            string sessionId = "";
            try
            {
                using (HttpConnection connection = new HttpConnection(endpoint, interrupt)) sessionId = Ask(connection);
            }
            catch (TransportException error)
            {
                end = error.End;
            }
            catch (Exception error) // of whatever kind: see WebSocketLink
            {
                end = new LinkEnd(LinkFailure.Unreachable, 0, error.Message);
            }
            Answer = new ProbeAnswer(endpoint, end, sessionId);
            hasEnded = true;
            news?.Set();
        }

        private string Ask(HttpConnection connection)
        {
            connection.SendRequest("/v1/info", "Connection: close\r\n");
            HttpHead head = connection.ReadHead();
            if (head.Status != 200) throw new TransportException(LinkFailure.NotAGateway, endpoint.Authority + " answers " + head.Status, head.Status);
            return FindText(connection.ReadText(head, MaxText), "session_id");
        }
    }
}
